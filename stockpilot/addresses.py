"""Addresses as given on the command line: scheme://host:port."""

from __future__ import annotations

from companion.errors import LinkError


def parse_address(text: str, schemes: tuple[str, ...], *, option: str) -> tuple[str, str, int]:
    """(scheme, host, port). An empty host means every interface (0.0.0.0). Raises: LinkError: what was expected."""
    scheme, separator, rest = text.partition("://")
    host, colon, port = rest.rpartition(":")
    allowed = " or ".join(f"{s}://HOST:PORT" for s in schemes)
    if not separator or scheme not in schemes or not colon or not port.isdigit() or not 0 < int(port) < 65536:
        raise LinkError(f"{option} {text}: expected {allowed}, for example {schemes[0]}://127.0.0.1:14540")
    return scheme, host or "0.0.0.0", int(port)
