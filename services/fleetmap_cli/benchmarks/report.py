"""A benchmark's results as Markdown tables and one JSON file, written anew after every row."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from fleetmap.files import write_text_atomically
from fleetmap_cli.benchmarks.machine import machine, versions
from fleetmap_cli.benchmarks.row import Benchmark, Figures, Group, Outcome, Value


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
                "group": outcome.group.title if outcome.group else None,
                "about": outcome.about,
                "status": outcome.status,
                "reason": outcome.reason,
                "figures": outcome.figures,
                "lines": outcome.lines,
                "reach": outcome.reach,
                "commands": list(outcome.commands),
                "pictures": list(outcome.pictures),
                "duration_s": round(outcome.duration_s, 1),
            }
            for outcome in outcomes
        ],
    }


def markdown(benchmark: Benchmark, outcomes: Sequence[Outcome]) -> str:
    """The tables, the rows without figures, the pictures, and the machine."""
    parts = [f"# {benchmark.name}: {benchmark.about}", tables(benchmark, outcomes)]
    if lines := [missing_line(outcome) for outcome in outcomes if outcome.status != "measured"]:
        parts.append("\n".join(f"* {line}" for line in lines))
    if pictures := dict.fromkeys(name for outcome in outcomes for name in outcome.pictures):
        parts.append("\n\n".join(f"![{Path(name).stem}]({name})" for name in pictures))
    facts = [f"{name}: {text}" for name, text in machine().items()]
    facts.append(", ".join(f"{name} {text}" for name, text in versions().items()))
    parts.append("\n".join(f"* {fact}" for fact in facts))
    return "\n\n".join(parts) + "\n"


def tables(benchmark: Benchmark, outcomes: Sequence[Outcome]) -> str:
    """One table, whose lines end with the commands that make them; or one a group, and all commands behind."""
    told = [outcome for outcome in outcomes if outcome.status != "skipped"]
    groups = list(dict.fromkeys(outcome.group for outcome in told if outcome.group is not None))
    if not groups:
        return _table("row", benchmark.columns, told, with_commands=True)
    parts = [_group_table(group, [o for o in told if o.group == group]) for group in groups]
    return "\n\n".join([*parts, "## Commands", *map(_commands, told)])


def _group_table(group: Group, outcomes: Sequence[Outcome]) -> str:
    table = _table("", group.columns, outcomes, with_commands=False)
    return "\n\n".join(part for part in (f"## {group.title}", group.about, table) if part)


def _table(corner: str, columns: Sequence[str], outcomes: Sequence[Outcome], *, with_commands: bool) -> str:
    """One line for a row's own figures, and one for each of those beside them."""
    every = [figures for outcome in outcomes for figures in (outcome.figures, *outcome.lines.values())]
    own = [name for name in columns if any(name in figures for figures in every)]
    failed = any(outcome.status == "failed" for outcome in outcomes)
    has_others = failed or any(set(figures) - set(own) for figures in every)
    has_reach = any(outcome.reach for outcome in outcomes)
    head = [*own, *["figures"] * has_others, *["reach"] * has_reach, *["command"] * with_commands]
    lines = [[corner, *head], ["---"] * (1 + len(head))]

    def add(label: str, figures: Figures, also: dict[str, str]) -> None:
        cells = {name: shown(figures.get(name)) for name in own} | {"figures": _others(figures, own)} | also
        lines.append([label, *(cells.get(name, "") for name in head)])

    for outcome in outcomes:
        also = {"reach": outcome.reach, "command": "<br>".join(f"`{command}`" for command in outcome.commands)}
        if outcome.status == "failed":
            also["figures"] = "failed"
        add(f"**{outcome.name}**: {outcome.about}", outcome.figures, also)
        for label, figures in outcome.lines.items():
            add(label, figures, {})
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)


def _commands(outcome: Outcome) -> str:
    return "\n".join([f"**{outcome.name}**", "", *(f"    {command}" for command in outcome.commands)])


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
