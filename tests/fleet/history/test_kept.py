"""Where a replay stood changes nothing but time: any split of the checks gives the same answer."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole.fleet.history import kept, run
from retropole.fleet.history.events import Watched
from retropole.fleet.history.model import Observed, together
from retropole.fleet.history.run import SiteChange, replay
from retropole.fleet.history.store import append
from retropole.fleet.history.watch import watch_all
from tests.fleet.history.checks import MOVED, SIGMA, checks, row
from tests.tiers import first_of

pytestmark = pytest.mark.full

WEEKS = 90


def drawn(site: int) -> Observed:
    """Draw a site: quiet, a step, a drift, or lorries."""
    rng = np.random.default_rng(site)
    lorries = MOVED * 3.0 * (rng.random((WEEKS, 1)) < 0.05) * rng.normal(size=(WEEKS, 6))
    change = (
        lambda k: 0.0,
        lambda k: MOVED * (k >= 40),
        lambda k: 0.05 * MOVED * max(k - 30, 0),
        lambda k: lorries[k],
    )[site % 4]
    found = together(checks(WEEKS, change, seed=site))
    return replace(found, other=np.arange(WEEKS) % 7 == 6) if site == 5 else found


SITES = [drawn(site) for site in range(8)]


def same(one: Watched, other: Watched) -> None:
    assert one.waiting == other.waiting
    assert len(one.events) == len(other.events)
    for a, b in zip(one.events, other.events, strict=True):
        assert (a.kind, a.onset, a.found) == (b.kind, b.onset, b.found)
        np.testing.assert_allclose([a.statistic, a.lead], [b.statistic, b.lead], rtol=1e-9)
        if a.size is not None and b.size is not None:
            np.testing.assert_allclose(a.size, b.size, rtol=1e-9, atol=1e-15)
    assert one.state is not None
    assert other.state is not None
    np.testing.assert_allclose(one.state.mean, other.state.mean, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(one.state.covariance, other.state.covariance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(one.scale, other.scale, rtol=1e-9)


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_any_split_into_runs_says_the_same(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "AFTER", 1 + 3 * (seed % 3))
    rng = np.random.default_rng(seed)
    states: list[kept.Kept] = [None] * len(SITES)
    done = np.zeros(len(SITES), dtype=int)
    while done.min() < WEEKS:
        done = np.minimum(done + rng.integers(0, 25, len(SITES)) + (done == 0), WEEKS)
        seen = [one[:count] for one, count in zip(SITES, done, strict=True)]
        said = kept.replayed(list(zip(seen, states, strict=True)))
        for (watched, _), whole in zip(said, watch_all(seen), strict=True):
            same(watched, whole)
        states = [new or old for (_, new), old in zip(said, states, strict=True)]
    assert any(watched.alarms for watched, _ in said)


def test_it_goes_on_from_there() -> None:
    one = SITES[0]
    ((_, state),) = kept.replayed([(one[:80], None)])
    assert state is not None
    stand = kept.decoded(state, one)
    assert stand is not None
    assert stand.count == 80
    # Few new checks: it is not kept anew.
    assert kept.replayed([(one[:82], state)])[0][1] is None


def test_other_checks_program_or_damage_replay_all(monkeypatch: pytest.MonkeyPatch) -> None:
    one = SITES[1]
    ((_, state),) = kept.replayed([(one[:60], None)])
    assert state is not None
    late = together([one[k] for k in range(WEEKS) if k != 3])
    other = replace(
        one, random=one.random * (1.0 + 1e-15 * (np.arange(WEEKS) == 59)[:, None, None])
    )
    for checks_now in (late, other, one[:59]):
        assert kept.decoded(state, checks_now) is None
        same(kept.replayed([(checks_now, state)])[0][0], watch_all([checks_now])[0])
    for k in range(0, len(state), len(state) // 40):
        damaged = state[:k] + bytes([state[k] ^ 1]) + state[k + 1 :]
        assert kept.decoded(damaged, one) is None
        assert kept.decoded(state[:k], one) is None
    monkeypatch.setattr(kept, "__version__", "another")
    assert kept.decoded(state, one) is None


def said_of(history: Path) -> list[SiteChange]:
    found, damaged = replay(str(history), ["lamp-1", "lamp-2"])
    assert not damaged
    return found


def test_a_history_says_the_same_with_it_without_it_and_with_late_checks(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="needs the extra fleet")
    rng = np.random.default_rng(2)
    rows = [
        row(k, name, step=SIGMA * rng.normal(size=6) + MOVED * (k >= 30))
        for k in range(50)
        for name in ("lamp-1", "lamp-2")
    ]
    late = rows.pop(21)
    for some in (rows[:61], rows[61:90], [late], rows[90:]):
        append(str(tmp_path), some)
        once, again = said_of(tmp_path), said_of(tmp_path)
        for path in (tmp_path / "state").iterdir():
            path.unlink()
        for one, other, anew in zip(once, again, said_of(tmp_path), strict=True):
            assert one.times == other.times == anew.times
            same(one.watched, anew.watched)
            same(other.watched, anew.watched)
    assert all(one.changes for one in once)


def test_where_it_cannot_be_kept_it_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow", reason="needs the extra fleet")
    append(str(tmp_path), [row(k, name) for k in range(3) for name in ("lamp-1", "lamp-2")])
    (tmp_path / "state").write_text("in the way")
    monkeypatch.setattr(run, "TOGETHER", 1)
    found, damaged = replay(str(tmp_path), ["lamp-1", "lamp-2"])
    assert len(found) == 2
    assert len(damaged) == 1
    assert "could not be kept" in str(damaged[0])
