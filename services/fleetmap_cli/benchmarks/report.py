"""A benchmark's results as one Markdown table and one JSON file, written anew after every row."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from fleetmap.files import write_text_atomically
from fleetmap_cli.benchmarks.machine import machine, versions
from fleetmap_cli.benchmarks.row import Benchmark, Figures, Outcome, Value


def write_report(folder: Path, benchmark: Benchmark, outcomes: Sequence[Outcome]) -> None:
    """Write NAME.md and NAME.json. Raises StorageError where the disk refuses."""
    write_text_atomically(folder / f"{benchmark.name}.md", markdown(benchmark, outcomes))
    content = json.dumps(as_json(benchmark, outcomes), indent=1, ensure_ascii=False)
    write_text_atomically(folder / f"{benchmark.name}.json", content + "\n")


def as_json(benchmark: Benchmark, outcomes: Sequence[Outcome]) -> dict[str, object]:
    """Everything there is to say, for other programs."""
    return {
        "benchmark": benchmark.name,
        "machine": machine(),
        "versions": versions(),
        "rows": [
            {
                "name": outcome.name,
                "about": outcome.about,
                "status": outcome.status,
                "reason": outcome.reason,
                "figures": outcome.figures,
                "commands": list(outcome.commands),
                "pictures": list(outcome.pictures),
                "duration_s": round(outcome.duration_s, 1),
            }
            for outcome in outcomes
        ],
    }


def markdown(benchmark: Benchmark, outcomes: Sequence[Outcome]) -> str:
    """The table, the rows without figures, the pictures, and the machine."""
    parts = [f"# {benchmark.name}: {benchmark.about}", table(benchmark, outcomes)]
    if lines := [missing_line(outcome) for outcome in outcomes if outcome.status != "measured"]:
        parts.append("\n".join(f"* {line}" for line in lines))
    if pictures := [name for outcome in outcomes for name in outcome.pictures]:
        parts.append("\n\n".join(f"![{Path(name).stem}]({name})" for name in pictures))
    facts = [f"{name}: {text}" for name, text in machine().items()]
    facts.append(", ".join(f"{name} {text}" for name, text in versions().items()))
    parts.append("\n".join(f"* {fact}" for fact in facts))
    return "\n\n".join(parts) + "\n"


def table(benchmark: Benchmark, outcomes: Sequence[Outcome]) -> str:
    """One line a measured or failed row, and the commands that make it."""
    own_columns = [name for name in benchmark.columns if any(name in outcome.figures for outcome in outcomes)]
    has_others = any(set(outcome.figures) - set(own_columns) for outcome in outcomes)
    head = ["row", *own_columns, *(["figures"] if has_others else []), "command"]
    lines = [head, ["---"] * len(head)]
    for outcome in outcomes:
        if outcome.status == "skipped":
            continue
        others = _others(outcome.figures, own_columns) if outcome.status == "measured" else "failed"
        cells = [shown(outcome.figures.get(name)) for name in own_columns]
        commands = "<br>".join(f"`{command}`" for command in outcome.commands)
        lines.append([f"**{outcome.name}**: {outcome.about}", *cells, *([others] if has_others else []), commands])
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)


def missing_line(outcome: Outcome) -> str:
    """Why a row has no figures."""
    return f"{outcome.status}: {outcome.name}, {outcome.reason}"


def shown(value: Value) -> str:
    """A figure as a cell of the table."""
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _others(figures: Figures, own_columns: Sequence[str]) -> str:
    return "; ".join(f"{name} {shown(value)}" for name, value in figures.items() if name not in own_columns)
