"""Liveliness tokens that one process at a time may hold."""

from __future__ import annotations

from collections.abc import Callable
from uuid import uuid4

import zenoh

from crkr.client.network.session import NotConnected

__all__ = ["standing", "take", "withdraw"]


def take(
    session: zenoh.Session, key: str, claim_key: Callable[[str], str], taken: str | None = None
) -> zenoh.LivelinessToken | None:
    """The token on a key, or None where somebody has it or wants it too.

    Who has it had claimed it before and lets go of the claim only after its token stands; so either shows.

    Args:
        session: Whose token it will be.
        key: Of the token.
        claim_key: Key of a claim to it, by the claim's name.
        taken: Key expression of the tokens of those who have it; the key unless given.

    Raises:
        NotConnected: Nobody told what stands.
    """
    claim, taken = claim_key(str(uuid4())), taken or key
    if standing(session, taken):
        return None
    claimed = session.liveliness().declare_token(claim)
    try:
        if standing(session, claim_key("*")) - {claim} or standing(session, taken):
            return None
        return session.liveliness().declare_token(key)
    finally:
        withdraw(claimed)


def standing(session: zenoh.Session, key: str) -> set[str]:
    """Keys of the tokens that stand; raises `NotConnected` where nobody tells."""
    replies = list(session.liveliness().get(key, zenoh.handlers.FifoChannel(16), timeout=0.5))
    if any(reply.ok is None for reply in replies) or not session.info.routers_zid():
        raise NotConnected("no answer about who is there")
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def withdraw(token: zenoh.LivelinessToken) -> None:
    """Takes a token back."""
    token.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type
