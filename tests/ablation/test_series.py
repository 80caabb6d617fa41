"""Number of Gaussians needed: by hand, and without an answer."""

import math

import numpy as np
import pytest

from gamba_warp.ablation.series import needed, qualities, series_of


def test_the_number_is_interpolated_in_the_logarithm():
    numbers = [1000, 4000, 16000]
    assert needed(numbers, [0.5, 0.9, 1.0], 0.9) == pytest.approx(4000)
    # Halfway between two qualities is the geometric mean of the numbers.
    assert needed(numbers, [0.5, 0.9, 1.0], 0.7) == pytest.approx(2000)
    assert needed(numbers, [0.5, 0.9, 1.0], 0.95) == pytest.approx(8000)
    assert needed(numbers, [0.5, 0.9, 1.0], 0.3) == 1000
    assert needed(numbers, [0.5, 0.9, 0.8], 0.95) is None
    # The smallest that reaches it, also where a larger one falls below again.
    assert needed(numbers, [0.5, 1.1, 1.0], 0.8) == pytest.approx(2000)


def test_quality_is_the_gain_over_an_empty_picture():
    got = qualities(np.array([[10.0, 10.0], [15.0, 9.0], [20.0, 8.0]]))
    assert got[:, 0].tolist() == [0.5, 1.0]
    assert np.isnan(got[:, 1]).all()
    assert qualities(np.zeros((1, 3))) is None


def test_a_series_by_hand():
    empty = {"a": 10.0, "b": 20.0, "c": 5.0, "other": 0.0}
    small = {"a": 14.0, "b": 28.0, "c": 6.0}
    large = {"a": 20.0, "b": 30.0, "c": 4.0}  # c gains nothing with the most
    got = series_of([1000, 4000], [small, large], empty)
    assert got["objects"] == 3 and got["no_gain"] == 1
    assert got["empty"] == pytest.approx(35 / 3)
    assert got["psnr"] == pytest.approx([16, 18])
    first = (16 - 35 / 3) / (18 - 35 / 3)
    assert got["quality"] == pytest.approx([first, 1])
    part = (0.95 - first) / (1 - first)
    want = math.exp(math.log(1000) + part * math.log(4))
    assert got["needed"]["95"]["number"] == pytest.approx(want)
    assert not got["needed"]["95"]["at_most"]
    # Of a 40 % and of b 80 % with the first row: neither has 87 %.
    assert got["reached"] == {"87": [0, 1], "95": [0, 1]}
    assert series_of([1000, 4000], [small, large], empty, [0.75])["reached"] == {"75": [0.5, 1]}


def test_a_series_without_an_answer():
    assert series_of([5], [{"a": 1.0}], {"a": 0.0}) is None
    assert series_of([5, 6], [{"a": 1.0}, {"b": 1.0}], {"a": 0.0}) is None
    worse = series_of([5, 6], [{"a": 1.0}, {"a": -1.0}], {"a": 0.0})
    assert worse["quality"] is None and worse["needed"]["95"]["number"] is None
    assert worse["no_gain"] == 1 and worse["reached"]["95"] == [None, None]
