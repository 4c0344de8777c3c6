"""Run the commands of the documents again, wholly or for some of their draws."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import random
import runpy
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

COUNTS = (
    *("--seeds", "--runs", "--draws", "--sites", "--setups", "--scenes"),
    *("--easy", "--hard", "--wrong", "--right"),
)
"""Options that say how many seeds a command draws, where they are followed by a number."""

LEAST = 5
"""Draws of each command: fewer hardly tell anything."""


def is_count(option: str, value: str) -> bool:
    """Whether a word says how many seeds an option draws: of none there is no share."""
    return option in COUNTS and value.isdigit() and int(value) > 0


def draws(command: str) -> int:
    """How many draws of each kind a command makes, at the least; 0 where it has no seeds."""
    words = shlex.split(command)
    numbers = []
    for option, value in pairwise(words):
        if is_count(option, value):
            numbers.append(int(value))
        elif option == "--seeds":
            numbers.append(len(range(*map(int, value.split(":")))))
    return min(numbers, default=0)


def one_draw(command: str, number: int) -> list[str]:
    """Words of the same command for one of its draws alone."""
    words = shlex.split(command)
    for i, (option, value) in enumerate(pairwise(words), start=1):
        if is_count(option, value):
            words[i] = "1"
        elif option == "--seeds":
            first, _, *step = map(int, value.split(":"))
            seed = first + number * (step[0] if step else 1)
            words[i] = f"{seed}:{seed + 1}"
        elif option == "--first":
            words[i] = str(int(value) + number)
        elif option in ("--processes", "--jobs"):
            words[i] = "1"
        elif option == "--hopeless":
            words[i] = "0"
    return words


def runnable(script: str) -> Callable[[], object]:
    """What a script does, or a package after `-m`; what scripts import stays for the next draw."""
    path, is_file = ROOT / script, script.endswith(".py")
    if path.parent.name == "examples":
        return partial(runpy.run_path, str(path), run_name="__main__")
    folder, name = (path.parent, f"run_{path.stem}") if is_file else (ROOT, f"{script}.__main__")
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    if is_file and name not in sys.modules:
        # Not by its own name: Python has a `site` too.
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    module = importlib.import_module(name)
    # A pool of processes would start anew for every draw.
    if hasattr(module, "ProcessPoolExecutor"):
        vars(module)["ProcessPoolExecutor"] = lambda *_, **__: ThreadPoolExecutor(1)
    return module.main  # type: ignore[no-any-return]


def printed(words: Sequence[str], data: Path | None = None) -> str:
    """What a command prints, run in this process; the files that it writes are forgotten."""
    script, *rest = [word for word in words[1:] if word != "-m"]
    run = runnable(script)
    if data is not None:
        rest = [str(data.resolve()) if word == "data" else word for word in rest]
    before, out = sys.argv, io.StringIO()
    sys.argv = [script, *rest]
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            contextlib.chdir(folder),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(io.StringIO()),
            contextlib.suppress(SystemExit),
        ):
            run()
    finally:
        sys.argv = before
    return out.getvalue()


def drawn(
    command: str, share: float, seconds: float, data: Path | None, whole: Collection[str]
) -> tuple[list[str], float]:
    """What a share of the draws of a command print, one by one, and the seconds that it took."""
    start = time.perf_counter()
    runs = 0 if command in whole else draws(command)
    if runs == 0:
        texts = [printed(shlex.split(command), data)]
    else:
        count = min(runs, max(LEAST, round(share * runs)))
        texts = []
        for number in random.Random(command).sample(range(runs), count):
            texts.append(printed(one_draw(command, number), data))
            if time.perf_counter() - start > seconds:
                break
    return texts, time.perf_counter() - start
