"""Progress bars on stderr: for work that goes through stages, and for bytes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from tqdm import tqdm


class StageBar:
    """Call it with stage, done and total; each stage gets a bar of its own."""

    def __init__(self) -> None:
        self._bar: tqdm[Any] | None = None
        self._stage = ""

    def __enter__(self) -> StageBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close(complete=kind is None)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps of a stage are finished."""
        if stage != self._stage or self._bar is None:
            self._close(complete=True)
            # disable=None: no bar where stderr is a file or a pipe
            bar: tqdm[Any] = tqdm(total=total, desc=stage, file=sys.stderr, disable=None)
            self._bar, self._stage = bar, stage
        self._bar.update(done - self._bar.n)

    def _close(self, complete: bool) -> None:
        if self._bar is None:
            return
        if complete and self._bar.total:
            self._bar.update(self._bar.total - self._bar.n)
        self._bar.close()
        self._bar = None


@contextmanager
def byte_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar to be called with the bytes done and the bytes in total."""
    with tqdm(
        desc=what, unit="B", unit_scale=True, unit_divisor=1000, file=sys.stderr, leave=False, disable=None
    ) as bar:

        def show(done_bytes: int, total_bytes: int) -> None:
            bar.total = total_bytes
            bar.update(done_bytes - bar.n)

        yield show
