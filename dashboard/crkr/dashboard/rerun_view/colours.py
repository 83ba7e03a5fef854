"""Colours with one meaning in every panel, as 0xRRGGBBAA."""

from __future__ import annotations

from typing import Final

__all__ = ["CRITERIA", "FAILURE", "LINES", "MEAN", "NEUTRAL", "SUCCESS", "shade"]

SUCCESS: Final = 0x3DDC84FF
FAILURE: Final = 0xFF5A4FFF
MEAN: Final = 0xFFCA28FF  # seen on dark and on light ground
NEUTRAL: Final = 0x9AA5B1FF
CRITERIA: Final = (0x4FC3F7FF, 0xFFB74DFF, 0xCE93D8FF, 0xAED581FF)
LINES: Final = (
    0x4FC3F7FF,
    0xFFB74DFF,
    0xCE93D8FF,
    0xAED581FF,
    0xFF8A80FF,
    0x80CBC4FF,
    0xF48FB1FF,
    0xFFF176FF,
)


def shade(colour: int, alpha: float) -> int:
    """The colour with another opacity in [0, 1]."""
    return (colour & 0xFFFFFF00) | round(255 * alpha)
