"""Who is there: names that hold a liveliness token, which Zenoh takes away when their process or link dies."""

from __future__ import annotations

from threading import Condition

import zenoh


class AliveNames:
    """The names under a prefix that are alive now, anywhere in the mesh; safe to use from several threads."""

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._names: set[str] = set()
        self._changed = Condition()
        self._subscriber = session.liveliness().declare_subscriber(f"{prefix}/*", self._note, history=True)

    @property
    def now(self) -> frozenset[str]:
        """Those who are there now."""
        with self._changed:
            return frozenset(self._names)

    def wait_for(self, names: frozenset[str], timeout_s: float) -> bool:
        """Wait until exactly these are there; False if the time was over first."""
        with self._changed:
            return self._changed.wait_for(lambda: self._names == names, timeout_s)

    def _note(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).rpartition("/")[2]
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._names.add(name)
            else:
                self._names.discard(name)
            self._changed.notify_all()
