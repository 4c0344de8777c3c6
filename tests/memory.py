"""How much memory a process has had in use."""

import resource
from pathlib import Path

STATUS = Path("/proc/self/status")


def peak_memory() -> int:
    """Most bytes that this process held at once.

    Not `ru_maxrss` where Linux tells more: that goes on from the process which started this one,
    so that a large pytest worker would count as ours.
    """
    if STATUS.exists():
        return 1024 * int(STATUS.read_text().split("VmHWM:")[1].split()[0])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
