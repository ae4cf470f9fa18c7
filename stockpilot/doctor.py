"""`stockpilot doctor`: is this vehicle fit to fly a mission, and if not, what is to be done."""

from __future__ import annotations

from typing import Annotated

import typer


def doctor(
    connect: Annotated[str, typer.Option(help="the ground station's link")] = "udpin://0.0.0.0:14550",
) -> None:
    """Check the vehicle before a mission."""
    raise typer.Exit(2)
