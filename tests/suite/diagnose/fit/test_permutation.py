"""The null of the search on sums whose truth is known: p-values are what they say."""

import numpy as np
from scipy.stats import kstest

from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.estimate.permutation import folds_of, score_candidates
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.vehicles import PLAIN

SPACE = make_space(PLAIN)
NAMES = ("linear_drag", "rotor_drag", "thrust_scale", "gyro_bias", "com_offset", "frame_tilt")
AMONG = [c for c in candidates(SPACE, False, {"command"}) if c.name in NAMES]
MIDDLE = 0.5 * (SPACE.array("low") + SPACE.array("high"))
WINDOWS, ROWS = 20, 12
FOLD = folds_of(np.repeat(np.arange(4), 5), np.tile(np.arange(5.0), 4))
DRAWS = 50


def equations(rng, colour=0.0, truth=None, size=0.0, alike=0.0):
    """Return normal equations of noise, plus `size` of what `truth` does in each window.

    One row's noise has the correlation `colour` with the next one; other effects have the share
    `alike` of the slope of `truth`.
    """
    count = len(SPACE.entries)
    slope = rng.standard_normal((WINDOWS, ROWS, count))
    noise = rng.standard_normal((WINDOWS, ROWS))
    for row in range(1, ROWS):
        noise[:, row] = colour * noise[:, row - 1] + np.sqrt(1 - colour**2) * noise[:, row]
    if truth is not None:
        true = next(c for c in AMONG if c.name == truth).indices[0]
        slope += alike * slope[..., true, None] * (np.arange(count) != true)
        noise = noise + size * slope[..., true]
    slope = slope / SPACE.array("step")
    turned = np.swapaxes(slope, 1, 2)
    cross = (turned @ noise[..., None])[..., 0]
    return NormalEquations(turned @ slope, cross, (noise**2).sum(axis=1))


def best_of(draws, named=(), among=AMONG, **options):
    """Return the best score of each of `draws` made data sets."""
    found = []
    for k in range(draws):
        made = equations(np.random.default_rng([7, k]), **options)
        found.append(score_candidates(made, MIDDLE, SPACE, named, among, FOLD, seed=k)[0])
    return found


def test_p_values_of_coloured_noise_are_uniform():
    found = best_of(DRAWS, colour=0.9)
    p_values = np.array([one.p_value for one in found])
    assert kstest(p_values, "uniform").pvalue > 0.005
    # Of 50 nulls 0.5 are expected at or below 1 %; 4 or more come with a chance of 0.2 %.
    assert np.sum(p_values <= 0.01) < 4
    assert sum(one.gain > one.chance for one in found) < 4, "one null in a hundred exceeds it"


def test_the_true_effect_wins_over_one_that_looks_like_it_which_adds_nothing_to_it():
    found = best_of(20, truth="rotor_drag", size=0.6, alike=1.0)
    # Gains on data left out are noisy; what looks alike is told apart by whole fits afterwards.
    assert sum(one.candidate.name == "rotor_drag" for one in found) >= 18
    assert max(one.p_value for one in found) <= 0.01
    least = 1.0 / (1 + THRESHOLDS.sign_draws)  # the record itself is one of the draws
    assert min(one.p_value for one in found) >= least * (1.0 - 1e-9)
    true = next(c for c in AMONG if c.name == "rotor_drag")
    others, named = [c for c in AMONG if c != true], list(true.indices)
    found = best_of(20, named, others, truth="rotor_drag", size=0.6, alike=1.0)
    # The null shuffles the named effect's own part as well, which makes it the more careful.
    assert sum(one.p_value <= 0.01 for one in found) < 3


def test_other_seeds_draw_another_null_and_one_seed_the_same():
    made = equations(np.random.default_rng(1))
    first, again, other = (
        score_candidates(made, MIDDLE, SPACE, [], AMONG, FOLD, seed=seed) for seed in (1, 1, 2)
    )
    assert first == again
    assert [s.gain for s in first] == [s.gain for s in other]
    assert first[0].chance != other[0].chance
