"""Reads a recording to its end and says how fast, and in how much memory; a process of its own, to be measurable.

Use it as ``python -m fleetmap_cli.benchmarks.reading RECORDING.mcap``.
"""

from __future__ import annotations

import json
import sys
import time
from collections import deque
from pathlib import Path

from fleetmap.drives import open_drive


def read_through(path: Path) -> dict[str, float]:
    """Decode every image and read every fix; memory is resident memory beyond that after the imports."""
    before_bytes = memory_bytes("VmRSS")
    started = time.perf_counter()
    drive = open_drive(path)
    fix_count = len(drive.gnss_fixes())
    counted = deque(enumerate(drive.frames(), start=1), maxlen=1)
    duration_s = time.perf_counter() - started
    return {
        "images": counted[0][0] if counted else 0,
        "fixes": fix_count,
        "size_bytes": path.stat().st_size,
        "duration_s": duration_s,
        "memory_bytes": max(0, memory_bytes("VmHWM") - before_bytes),
    }


def memory_bytes(field: str) -> int:
    """A field of Linux' /proc/self/status: VmRSS is resident memory now, VmHWM its peak so far."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024
    raise KeyError(field)


if __name__ == "__main__":
    print(json.dumps(read_through(Path(sys.argv[1]))))
