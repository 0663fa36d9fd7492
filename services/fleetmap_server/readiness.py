"""Whether what a server depends on answers, told within a bound even where it hangs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from threading import Lock, Thread

from fleetmap.errors import FleetmapError

Check = Callable[[], object]  # raises a FleetmapError if something does not answer


class Readiness:
    """Asks each of several things in a thread of its own, and one that hangs not twice.

    Args:
        checks: what to ask, by name.
        within_s: how long to wait for all of them.
    """

    def __init__(self, checks: Mapping[str, Check], within_s: float = 3.0) -> None:
        self._checks = checks
        self._within_s = within_s
        self._lock = Lock()
        self._under_way: dict[str, Future[None]] = {}

    def failures(self) -> list[str]:
        """One line for each thing that does not answer; empty if all do."""
        asked = {name: self._ask(name) for name in self._checks}
        wait(asked.values(), timeout=self._within_s)
        return [failure for name, answer in asked.items() if (failure := self._failure(name, answer))]

    def _ask(self, name: str) -> Future[None]:
        with self._lock:
            answer = self._under_way.get(name)
            if answer is None or answer.done():
                answer = self._under_way[name] = Future()
                Thread(target=_run, args=(self._checks[name], answer), name=f"ready-{name}", daemon=True).start()
            return answer

    def _failure(self, name: str, answer: Future[None]) -> str | None:
        if not answer.done():
            return f"the {name} does not answer within {self._within_s:g} s"
        error = answer.exception()
        if error is None:
            return None
        return f"the {name} fails: {error if isinstance(error, FleetmapError) else type(error).__name__}"


def _run(check: Check, answer: Future[None]) -> None:
    try:
        check()
    except Exception as error:
        answer.set_exception(error)
    else:
        answer.set_result(None)
