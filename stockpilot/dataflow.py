"""docs/dataflow.md's table, from the topics themselves: `python -m stockpilot.dataflow` rewrites it."""

from __future__ import annotations

import sys
from pathlib import Path

from companion.topics import SCAN, TOPICS, Topic

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "dataflow.md"
BEGIN, END = "<!-- topics: begin (make docs) -->", "<!-- topics: end -->"


def _row(topic: Topic) -> str:
    rate = f"{topic.rate_hz:g} Hz" if topic.rate_hz else "on change"
    queue = "newest only" if topic.queue == 1 else f"{topic.queue}, drops the oldest"
    stale = f"{topic.stale_after_s:g} s" if topic.stale_after_s is not None else "never"
    recorded = "as its packets" if topic is SCAN else "yes" if topic.recorded else "no"
    sinks = ", ".join(topic.sinks)
    return f"| `{topic.name}` | {topic.message.__name__} | {topic.source} | {sinks} | {rate} | {queue} | {stale} | {recorded} |"


def topics_table() -> str:
    head = "| topic | message | from | to | rate | queue | stale after | recorded |\n|---|---|---|---|---|---|---|---|"
    return "\n".join([head, *(_row(topic) for topic in TOPICS)])


def with_table(text: str) -> str:
    """The document with its generated part renewed. Raises: ValueError: no markers."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"expected the lines {BEGIN!r} and {END!r} in {DOCUMENT.name}")
    return f"{before}{BEGIN}\n{topics_table()}\n{END}{after}"


def main() -> None:
    renewed = with_table(DOCUMENT.read_text(encoding="utf-8"))
    DOCUMENT.write_text(renewed, encoding="utf-8")
    print(f"wrote {DOCUMENT}", file=sys.stderr)


if __name__ == "__main__":
    main()
