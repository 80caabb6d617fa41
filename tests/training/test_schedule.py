"""Schedules at the steps where their values are known."""

import pytest

from gamba_warp.train.optim import ema_decay, learning_rate, novel_views, radial_weight


def test_learning_rate():
    values = [learning_rate(step, 110, 1.0, 10) for step in range(111)]
    assert values[0] == pytest.approx(1 / 11)
    assert values[9] == pytest.approx(10 / 11)
    assert values[10] == 1.0
    assert values[60] == pytest.approx(0.5)
    assert values[110] == pytest.approx(0.0, abs=1e-12)
    assert all(a < b for a, b in zip(values[:10], values[1:11]))
    assert all(a > b for a, b in zip(values[10:], values[11:]))
    assert learning_rate(200, 110, 1.0, 10) == pytest.approx(0.0, abs=1e-12)
    assert learning_rate(0, 5, 2.0, 0) == 2.0


def test_novel_views_grow_from_first_to_last_in_equal_shares():
    views = [novel_views(i / 100, 2, 6) for i in range(101)]
    assert [views.count(n) for n in (2, 3, 4, 5, 6)] == [20, 20, 20, 20, 21]
    assert views == sorted(views)
    assert novel_views(0.0, 3, 3) == novel_views(1.0, 3, 3) == 3


def test_radial_weight_falls_to_zero():
    assert radial_weight(0, 0.1, 40) == 0.1
    assert radial_weight(20, 0.1, 40) == pytest.approx(0.05)
    assert radial_weight(40, 0.1, 40) == radial_weight(400, 0.1, 40) == 0
    assert radial_weight(0, 0.1, 0) == 0


def test_ema_decay_is_short_at_first():
    assert ema_decay(0, 0.99) == pytest.approx(0.1)
    assert ema_decay(90, 0.99) == pytest.approx(0.91)
    assert ema_decay(10**6, 0.99) == 0.99
