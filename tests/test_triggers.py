"""A fraction knows its band, and a trigger that must be sure is wrong as seldom as it says."""

import pickle

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from gdptlab.experiment.channel import Channel
from gdptlab.live import Fraction, MiddleThird, Trigger, middle_thirds
from gdptlab.live.triggers import fraction_of

CHANNEL = Channel(width_um=90, height_um=60)


@pytest.mark.parametrize(("k", "n"), [(0, 7), (9, 10), (49, 50), (50, 50), (91, 100)])
def test_without_error_bars_the_band_is_the_exact_binomial_one(k, n):
    inside = np.arange(n) < k
    fraction = fraction_of(inside, inside.astype(float), 0.05)
    expected = binomtest(k, n).proportion_ci(0.9, method="exact")
    assert fraction == k / n
    assert (fraction.low, fraction.high) == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize("n", [25, 50, 100])
@pytest.mark.parametrize("std_um", [0.0, 1.5])
def test_a_sure_trigger_is_wrong_as_seldom_as_it_says(n, std_um):
    """Samples whose fraction is just below the level, measured with error."""
    rng, wrong, plain = np.random.default_rng(n), 0, 0
    third = MiddleThird(of="h", channel=CHANNEL, to_channel=lambda t: t)
    sure = Trigger(name="h", fraction=third, action=print, sure=True)
    for _ in range(1000):
        inside = rng.random(n) < 0.895
        z_um = np.where(inside, rng.uniform(-10, 10, n), rng.uniform(10, 30, n)) + std_um * rng.standard_normal(n)
        fraction = third(pd.DataFrame({"y_channel_um": 0.0, "z_um": z_um, "z_std_um": std_um}))
        wrong += sure.after(False, fraction, n)
        plain += fraction >= 0.9
    assert wrong <= 50 + 3 * np.sqrt(50)  # 5 % of 1000
    if std_um == 0:  # errors carry more particles out of the dense middle than into it, and lower the fraction
        assert plain > 200


def test_error_bars_at_the_boundary_widen_the_band_and_elsewhere_do_not():
    def band(y, std):
        table = pd.DataFrame({"y_channel_um": y, "z_um": 0.0, "y_std_um": std})
        return MiddleThird(of="w", channel=CHANNEL, to_channel=lambda t: t)(table)

    y = np.where(np.arange(40) < 30, 14.9, 40.0)
    sharp, far, near = band(y, 1e-6), band(np.where(y < 15, 0.0, y), 1.0), band(y, 1.0)
    assert far == sharp == near == 0.75
    assert (far.low, far.high) == pytest.approx((sharp.low, sharp.high))
    assert near.low < sharp.low - 0.01 and near.high > sharp.high + 0.01


def test_a_fraction_is_a_number_that_can_be_sent():
    fraction = pickle.loads(pickle.dumps(Fraction(0.9, 0.8, 0.95)))
    assert (fraction, fraction.low, fraction.high) == (0.9, 0.8, 0.95)
    none = fraction_of(np.zeros(0, bool), np.zeros(0), 0.05)
    assert np.isnan([none, none.low, none.high]).all()
    assert not Trigger(name="w", fraction=len, action=print, sure=True).after(False, none, 10)
    assert Trigger(name="w", fraction=len, action=print, sure=True).after(False, 0.9, 10)  # no band: as it is


def test_bad_rates_are_refused():
    for rate in (0, 0.5, -1):
        with pytest.raises(ValueError, match="false_alarms"):
            middle_thirds(CHANNEL, lambda t: t, rate)
    with pytest.raises(TypeError, match="sure"):
        Trigger(name="w", fraction=len, action=print, sure=1)
