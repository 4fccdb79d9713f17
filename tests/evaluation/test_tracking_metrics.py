"""CLEAR, identity and HOTA: what a hand computes, and what the definitions give when followed to the letter."""

import itertools
import math

import numpy as np
import pytest

from jaxfit.evaluation.tracking import Clear, clear, hota, idf1


def case(*frames, birds=1, tracks=1):
    """Each frame: {(bird, track): IoU}; a bird alone is (bird, None), a track alone (None, track)."""
    T = len(frames)
    iou, true, found = np.zeros((T, birds, tracks)), np.zeros((T, birds), bool), np.zeros((T, tracks), bool)
    for t, frame in enumerate(frames):
        for (m, n), value in frame.items():
            if m is not None:
                true[t, m] = True
            if n is not None:
                found[t, n] = True
            if None not in (m, n):
                iou[t, m, n] = value
    return iou, true, found


A, B = {(0, 0): 1.0}, {(0, 1): 1.0}
ALONE, NOBODY = {(0, None): 0}, {}


def test_a_switch():
    """Another track takes the bird over: each of four matches shares two frames of the bird's four."""
    both = case(A, A, B, B, tracks=2)
    assert clear(*both) == Clear(1 - 1 / 4, 1, 0)
    assert idf1(*both) == 2 * 2 / (4 + 4)
    assert hota(*both) == pytest.approx((math.sqrt(1 / 2), 1, 1 / 2))


def test_a_fragment():
    both = case(A, A, ALONE, A, A)
    assert clear(*both) == Clear(1 - 1 / 5, 0, 1)
    assert idf1(*both) == pytest.approx(2 * 4 / (5 + 4))
    assert hota(*both) == pytest.approx((4 / 5, 4 / 5, 4 / 5))


@pytest.mark.parametrize(
    ("frames", "fragments"),
    [
        ((ALONE, A, A, ALONE), 0),  # found late and lost early is no interruption
        ((A, NOBODY, A), 0),  # the bird was not there
        ((A, ALONE, ALONE, A), 1),
        ((A, ALONE, NOBODY, A, ALONE, A), 2),
        ((ALONE, ALONE), 0),
    ],
)
def test_what_is_an_interruption(frames, fragments):
    assert clear(*case(*frames)).fragments == fragments


@pytest.mark.parametrize(("value", "thresholds", "mota", "identity"), [(0.62, 12, 1, 1), (0.4, 8, -1, 0)])
def test_how_much_must_overlap(value, thresholds, mota, identity):
    """HOTA counts the share of its 19 thresholds; the others need an IoU of one half."""
    both = case(*[{(0, 0): value}] * 4)
    assert clear(*both).mota == mota
    assert idf1(*both) == identity
    assert hota(*both) == pytest.approx((thresholds / 19,) * 3)


def test_exactly_at_a_threshold():
    """An overlap of one half is a match, and keeps the track of a bird that another track fits better."""
    both = case(*[{(0, 0): 0.5}] * 2)
    assert (clear(*both).mota, idf1(*both)) == (1, 1)
    assert hota(*both).hota == pytest.approx(10 / 19)
    assert clear(*case(A, {(0, 0): 0.5, (0, 1): 0.9}, tracks=2)) == Clear(1 - 1 / 2, 0, 0)  # a false alarm
    assert clear(*case(A, {(0, 0): 0.4, (0, 1): 0.9}, tracks=2)) == Clear(1 - 2 / 2, 1, 0)  # and a switch


def test_nothing_at_all():
    both = np.zeros((3, 0, 0)), np.zeros((3, 0), bool), np.zeros((3, 0), bool)
    assert all(math.isnan(figure) for figure in (clear(*both).mota, idf1(*both), *hota(*both)))


def random_case(seed):
    """Birds with a favourite track each, gaps on both sides, and frames without anything."""
    rng = np.random.default_rng(seed)
    T, M, N = rng.integers(1, 9), rng.integers(1, 4), rng.integers(1, 5)
    true, found = rng.random((T, M)) < rng.choice([0.5, 0.9, 1]), rng.random((T, N)) < rng.choice([0.5, 0.9, 1])
    iou = rng.random((T, M, N)) * (rng.random((T, M, N)) < rng.choice([0.3, 0.7, 1]))
    for m, own in enumerate(rng.integers(0, N, M)):
        iou[:, m, own] = np.maximum(iou[:, m, own], rng.random(T) ** 0.3)
    return iou * true[:, :, None] * found[:, None], true, found


def pairings(M, N):
    """All ways to pair M with N, as lists of (m, n)."""
    small = min(M, N)
    for rows in itertools.combinations(range(M), small):
        for columns in itertools.permutations(range(N), small):
            yield list(zip(rows, columns, strict=True))


def idf1_by_definition(iou, true, found):
    """The naming of tracks with the fewest wrong frames, all tried."""
    best = math.inf
    for pairs in pairings(*iou.shape[1:]):
        right = sum((iou[:, m, n] >= 0.5).sum() for m, n in pairs)
        best = min(best, true.sum() + found.sum() - 2 * right)
    return 1 - best / (true.sum() + found.sum())


def clear_by_definition(iou, true, found):
    """MOTA and switches, with pairings tried one by one; a pair kept from before outweighs all else."""
    before, last, errors, switches = {}, {}, 0, 0
    for t in range(len(iou)):
        if not (true[t].any() and found[t].any()):
            errors += true[t].sum() + found[t].sum()
            continue
        best, chosen = -1.0, []
        for pairs in pairings(*iou.shape[1:]):
            pairs = [(m, n) for m, n in pairs if iou[t, m, n] >= 0.5]
            value = sum(iou[t, m, n] + 100 * (before.get(m) == n) for m, n in pairs)
            if value > best:
                best, chosen = value, pairs
        switches += sum(m in last and last[m] != n for m, n in chosen)
        before = dict(chosen)
        last |= before
        errors += true[t].sum() + found[t].sum() - 2 * len(chosen)
    return 1 - (errors + switches) / true.sum(), switches


def hota_by_definition(iou, true, found):
    """Match by match: TPA, FNA and FPA counted over the frames, with the assignments tried one by one."""
    T, M, N = iou.shape
    agreement = np.zeros((M, N))
    for m, n in itertools.product(range(M), range(N)):
        together = 0.0
        for t in range(T):
            if iou[t, m, n]:
                together += iou[t, m, n] / (iou[t, m].sum() + iou[t, :, n].sum() - iou[t, m, n])
        if together:
            agreement[m, n] = together / (true[:, m].sum() + found[:, n].sum() - together)
    assigned = [max(pairings(M, N), key=lambda p: sum(agreement[m, n] * iou[t, m, n] for m, n in p)) for t in range(T)]
    scores = []
    for alpha in np.arange(1, 20) / 20:
        matches = [(t, m, n) for t in range(T) for m, n in assigned[t] if iou[t, m, n] >= alpha]
        if not matches:
            scores.append(0)
            continue
        association = 0.0
        for _, m, n in matches:
            tpa = sum((m, n) == (i, j) for _, i, j in matches)
            association += tpa / (tpa + (true[:, m].sum() - tpa) + (found[:, n].sum() - tpa))
        detection = len(matches) / (true.sum() + found.sum() - len(matches))
        scores.append(math.sqrt(detection * association / len(matches)))
    return np.mean(scores)


def test_definitions_followed_to_the_letter():
    cases = 0
    for seed in range(120):
        both = random_case(seed)
        if not both[1].any():
            continue
        cases += 1
        own = clear(*both)
        assert (own.mota, own.switches) == pytest.approx(clear_by_definition(*both)), seed
        assert idf1(*both) == pytest.approx(idf1_by_definition(*both)), seed
        assert hota(*both).hota == pytest.approx(hota_by_definition(*both)), seed
    assert cases > 100


def test_another_implementation_agrees():
    """That of the MOTChallenge, as the optional package of trackers carries it."""
    judge = pytest.importorskip("trackers.eval")
    for seed in range(100):
        iou, true, found = random_case(seed)
        if not (true.any() and found.any()):
            continue
        ids = [[np.flatnonzero(row) for row in there] for there in (true, found)]
        both = *ids, [iou[t][np.ix_(rows, columns)] for t, (rows, columns) in enumerate(zip(*ids, strict=True))]
        theirs, own = judge.compute_clear_metrics(*both), clear(iou, true, found)
        assert (own.mota, own.switches) == pytest.approx((theirs["MOTA"], theirs["IDSW"])), seed
        assert idf1(iou, true, found) == pytest.approx(judge.compute_identity_metrics(*both)["IDF1"]), seed
        theirs = judge.compute_hota_metrics(*both)
        assert hota(iou, true, found) == pytest.approx([theirs[name] for name in ("HOTA", "DetA", "AssA")]), seed
