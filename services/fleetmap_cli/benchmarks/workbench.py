"""Where a row is measured: a folder of its own, in which the commands run exactly as the row shows them."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fleetmap.errors import RunError
from fleetmap_cli.benchmarks.row import Figures

_FLEETMAP = (sys.executable, "-P", "-c", "from fleetmap_cli.main import main; main()")
_DATA = "DATA/"


class CannotMeasureHereError(Exception):
    """The row cannot be measured here; the message says what it needs."""


@dataclass(frozen=True)
class Run:
    """A command that ended well."""

    stdout: str
    stderr: str
    duration_s: float

    def json(self) -> Any:
        """What it printed, as JSON."""
        return json.loads(self.stdout)


@dataclass
class Workbench:
    """The folders of a row, and the commands it has run."""

    data: Path  # shown as DATA in commands
    folder: Path  # commands run in it; removed afterwards
    output: Path  # pictures go here
    commands: list[str] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)
    lines: dict[str, Figures] = field(default_factory=dict)
    finished: dict[str, Run] = field(default_factory=dict)  # by ``once``, of all rows that share the folder

    def once(self, command: str, *, accepted_codes: tuple[int, ...] = (0,)) -> Run:
        """Like ``fleetmap``; but what an earlier row has run in the same folder is shown, and not run again."""
        if command not in self.finished:
            self.finished[command] = self.fleetmap(command, accepted_codes=accepted_codes)
        elif f"fleetmap {command}" not in self.commands:
            self.shown(f"fleetmap {command}")
        return self.finished[command]

    def fleetmap(self, command: str, *, accepted_codes: tuple[int, ...] = (0,)) -> Run:
        """Run ``fleetmap COMMAND`` in a process of its own; words that begin with DATA/ lie in the data folder.

        Raises:
            RunError: it ended with another exit code than those accepted; the message holds the last it said.
        """
        self.commands.append(f"fleetmap {command}")
        return self._run(command, [*_FLEETMAP, *self._words(command)], accepted_codes)

    def python_module(self, module: str, arguments: str) -> Run:
        """Run ``python -m MODULE ARGUMENTS`` likewise."""
        self.commands.append(f"python -m {module} {arguments}")
        return self._run(module, [sys.executable, "-P", "-m", module, *self._words(arguments)], (0,))

    def shown(self, command: str) -> None:
        """Name a command that the row's figures come from without running it: the benchmark's own."""
        self.commands.append(command)

    def beside(self, label: str, figures: Figures) -> None:
        """Add a line to the row's table below its own figures."""
        self.lines[label] = figures

    def picture(self, name: str) -> Path:
        """Where to write a picture that belongs to the row."""
        self.pictures.append(name)
        return self.output / name

    def _words(self, command: str) -> list[str]:
        words = shlex.split(command)
        return [str(self.data / word.removeprefix(_DATA)) if word.startswith(_DATA) else word for word in words]

    def _run(self, name: str, words: list[str], accepted_codes: tuple[int, ...]) -> Run:
        started = time.perf_counter()
        done = subprocess.run(words, cwd=self.folder, capture_output=True, text=True, check=False)
        duration_s = time.perf_counter() - started
        if done.returncode not in accepted_codes:
            said = [line for line in done.stderr.strip().splitlines() if line.strip()]
            reason = said[-1].replace(str(self.data), "DATA") if said else "it said nothing"
            raise RunError(f"'fleetmap {name.split()[0]}' ended with exit code {done.returncode}: {reason}")
        return Run(done.stdout, done.stderr, duration_s)
