"""Sums for every bird, intervals over birds and paired ratios: what a hand computes, and a resampling by loops."""

import math

import numpy as np
import pytest

from jaxfit.evaluation.bootstrap import BirdSums, Interval, paired_ratio


def sums(**metrics):
    """Metric = pairs (numerator, count), one a bird."""
    birds = tuple("abcdefgh"[: len(next(iter(metrics.values())))])
    numerators = {name: tuple(n for n, _ in pairs) for name, pairs in metrics.items()}
    return BirdSums(birds, numerators, {name: tuple(c for _, c in pairs) for name, pairs in metrics.items()})


def test_two_birds_by_hand():
    """A bird with more samples weighs more: the root of the pooled mean, not the mean of roots."""
    found = sums(me_p=[(4.0, 1), (8.0, 3)], iou=[(0.5, 1), (1.5, 3)])
    assert found.value("me_p") == math.sqrt(12 / 4)
    assert found.value("iou") == 2 / 4
    assert found.values() == {"me_p": math.sqrt(3), "iou": 0.5}


def test_sums_of_samples_by_hand():
    nan = math.nan
    error = np.array([[[1.0, 4], [nan, 2]], [[nan, nan], [9, nan]]])
    found = BirdSums.of([7, 3], {"me_p": error})
    assert found == BirdSums(("7", "3"), {"me_p": (7.0, 9.0)}, {"me_p": (3, 1)})
    first = BirdSums.of([7, 3], {"me_p": error}, np.array([[True, False], [True, False]]))
    assert first == BirdSums(("7", "3"), {"me_p": (5.0, 0.0)}, {"me_p": (2, 0)})
    assert first.measured("me_p") == ["7"]
    assert first.value("me_p") == math.sqrt(2.5)


def test_the_interval_is_that_of_whole_birds_drawn():
    """Against all 3³ draws of three birds, whose percentiles the resamples must come near."""
    pairs = np.array([(1.0, 10), (30.0, 20), (5.0, 5)])
    draws = np.stack(np.meshgrid(*[range(3)] * 3), -1).reshape(-1, 3)
    numerator, count = pairs[draws].sum(1).T
    exact = np.sort(np.sqrt(numerator / count))
    low, high = sums(me_v=[tuple(pair) for pair in pairs]).interval("me_v")
    assert (low, high) == pytest.approx((exact[0], exact[-1]))  # either end has 1 of 27 draws, more than 2.5 %
    many = np.random.default_rng(0).lognormal(size=40)
    found = sums_of_many(many)
    means = np.random.default_rng(1).choice(many, (20_000, 40)).mean(1)
    assert found.interval("iou") == pytest.approx(np.percentile(means, [2.5, 97.5]), rel=0.03)
    assert found.interval("iou") == sums_of_many(many).interval("iou") != found.interval("iou", seed=1)


def sums_of_many(values):
    return BirdSums(tuple(map(str, range(len(values)))), {"iou": tuple(values)}, {"iou": (1,) * len(values)})


def test_fewer_than_two_birds_have_no_interval():
    one = sums(me_p=[(4.0, 1), (0.0, 0)], me_v=[(0.0, 0), (0.0, 0)])
    assert one.value("me_p") == 2
    assert math.isnan(one.value("me_v"))
    for interval in one.intervals().values():
        assert isinstance(interval, Interval)
        assert np.isnan(interval).all()


def test_a_bird_without_samples_changes_nothing():
    some = sums(me_p=[(4.0, 1), (9.0, 1), (3.0, 2)])
    more = sums(me_p=[(4.0, 1), (0.0, 0), (9.0, 1), (3.0, 2)])
    assert more.interval("me_p") == some.interval("me_p")


def test_a_paired_ratio_by_hand():
    """Birds far apart, but every one better by the same factor: no doubt about the ratio, much about either."""
    a = sums(me_p=[(1.0, 1), (90.0, 2), (4.0, 1)])
    b = sums(me_p=[(9.0, 1), (810.0, 2), (36.0, 1)])
    assert paired_ratio([(a, b)], "me_p") == pytest.approx((1 / 3, 1 / 3, 1 / 3, 3))
    assert np.ptp(a.interval("me_p")) > 3
    assert paired_ratio([(b, a)], "me_p").value == pytest.approx(3)
    assert paired_ratio([(a, a)], "me_p") == (1, 1, 1, 3)


def test_several_pairs_are_drawn_together():
    """Geometric mean over pairs; what one pair gains on a bird and the other loses on it leaves no doubt."""
    even = sums(iou=[(1.0, 1), (1.0, 1), (1.0, 1)])
    twice = sums(iou=[(2.0, 1), (2.0, 1), (2.0, 1)])
    eight = sums(iou=[(8.0, 1), (8.0, 1), (8.0, 1)])
    assert paired_ratio([(twice, even), (eight, even)], "iou") == pytest.approx((4, 4, 4, 3))
    up, down = sums(iou=[(1.0, 1), (2.0, 1), (4.0, 1)]), sums(iou=[(1.0, 1), (0.5, 1), (0.25, 1)])
    alone = paired_ratio([(up, even)], "iou")
    assert alone.high - alone.low > 2
    found = paired_ratio([(up, even), (even, up)], "iou")
    assert found == pytest.approx((1, 1, 1, 3))
    assert paired_ratio([(up, even), (down, even)], "iou").value == pytest.approx(math.sqrt(7 / 3 * 1.75 / 3))


def test_birds_are_paired_by_name():
    """In another order, and one that b could not measure."""
    a = BirdSums(("1", "2", "3"), {"iou": (0.9, 0.2, 0.4)}, {"iou": (1, 1, 1)})
    b = BirdSums(("3", "2", "1"), {"iou": (0.8, 0.0, 1.8)}, {"iou": (1, 0, 1)})
    assert paired_ratio([(a, b)], "iou") == pytest.approx((0.5, 0.5, 0.5, 2))
    one = paired_ratio([(a, BirdSums(("2", "9"), {"iou": (0.1, 0.5)}, {"iou": (1, 1)}))], "iou")
    assert (one.value, one.birds) == (pytest.approx(2), 1)
    assert np.isnan([one.low, one.high]).all()
    none = paired_ratio([(a, BirdSums(("9",), {"iou": (0.5,)}, {"iou": (1,)}))], "iou")
    assert none.birds == 0
    assert math.isnan(none.value)


def test_a_metric_that_is_none():
    found = sums(iou=[(0.5, 1), (0.5, 1)])
    for ask in (found.interval, found.value, lambda name: paired_ratio([(found, found)], name)):
        with pytest.raises(ValueError, match="metric must be one of iou, not me_p"):
            ask("me_p")
