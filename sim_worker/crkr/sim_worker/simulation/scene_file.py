"""Scene files in MuJoCo's format, with the files that they include written into them."""

from __future__ import annotations

from importlib.resources import files
from importlib.resources.abc import Traversable
from posixpath import normpath
from xml.etree import ElementTree as ET

__all__ = ["scene_xml"]

PACKAGE = "crkr.sim_worker"


def scene_xml(folder: str) -> str:
    """The text of `scene.xml` in a folder of this package, e.g. "table_tennis", complete in itself.

    Paths of included files are relative to that folder, as MuJoCo has it; Pinocchio would ignore the includes.
    """
    root = files(PACKAGE)
    return ET.tostring(_complete(root, folder, "scene.xml"), encoding="unicode")


def _complete(root: Traversable, folder: str, name: str) -> ET.Element:
    text = root.joinpath(*normpath(f"{folder}/{name}").split("/")).read_text(encoding="utf-8")
    element = ET.fromstring(text)
    for parent in list(element.iter()):
        for place, child in reversed(list(enumerate(parent))):
            if child.tag == "include":
                parent[place : place + 1] = list(_complete(root, folder, child.attrib["file"]))
    return element
