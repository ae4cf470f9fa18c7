"""`kernel` for the stage's inner loops: see companion.jit."""

from companion.jit import kernel

__all__ = ["kernel"]
