"""What holds for all tests."""

from __future__ import annotations

from hypothesis import settings

# A kernel is compiled by whichever test calls it first on a computer: seconds, where the deadline is 0.2 s an example.
settings.register_profile("stockpilot", deadline=None)
settings.load_profile("stockpilot")
