"""Every number that the diagnosis judges by, in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Thresholds:
    """What counts as enough, near, sure or beyond noise, in the order of the diagnosis's steps."""

    most_windows: int = 200
    """Stretches of a second that are flown at most: more take longer and add little."""
    most_rotor_windows: int = 100
    """The same where measured rotor speeds drive: their errors along a stretch are estimated too,
    which takes twice as long."""
    most_rows: int = 100_000
    """Rows of all flights together that force and torque use at most; of more each so many-th."""
    longest_hole_s: float = 0.1
    """Rows further apart are a hole: no window or rotor lag reaches across it [s]."""
    fitted_loop_share: float = 0.5
    """Rotor speeds that the nominal rate loop misses by more than this share of how they change
    are another controller's: they are the input then [1]."""
    speed_mean_s: float = 0.1
    """Rotor speeds are compared with the loop's as means over this time, to be rid of noise [s]."""
    still_speed: float = 10.0
    """Rotor speeds that change by less, or are off by less, do not count [rad/s]."""
    loop_settled_s: float = 0.3
    """After the first row, until the rotors' lag has forgotten how they began [s]."""
    lag_settled_s: float = 0.2
    """Left out after each hole where lags are fitted, for the same reason [s]."""
    longest_lag_s: float = 0.15
    """Slowest motors that are thought of [s]."""
    lag_followed_share: float = 0.99
    """Commands show the rotors' lag where they give this share of how the speeds change, with it:
    where speeds change little, noise of the rates in the commanded speeds looks like a lag [1]."""
    lag_closed_share: float = 0.25
    """And where it closes this share of the squared error that the vehicle's lag leaves [1]."""
    lag_least_flights: int = 3
    """Flights that show it must be as many."""
    longest_delay_s: float = 0.06
    """Latest commands that are thought of [s]."""
    delays_tried: int = 9
    """Delays up to the longest that are tried before the best is refined."""
    actuator_flight_s: float = 60.0
    """Flight that is enough to compare rotor speeds; what is logged beyond does not count [s]."""
    held_out_share: float = 0.2
    """Share of the flights that is held out, at least one [1]."""
    lone_fitted_share: float = 0.7
    """Share of a lone flight that is fitted; the end is held out [1]."""
    noise_rows: int = 20
    """Rows that a polynomial is taken off: a model's error in 0.2 s is negligible then."""
    rotor_noise_rows: int = 8
    """The same for rotor speeds that are an input, which change faster."""
    noise_degree: int = 3
    """Degree of that polynomial."""
    colour_degree: int = 3
    """Degree of the polynomial that is taken off a second before its noise gets a colour: what
    errors of its start make of it."""
    colour_gain: float = 3.0
    """Rise of the log-likelihood below which noise is taken for white [1]."""
    drift_gain: float = 3.0
    """Rise of the log-likelihood below which there is no error of the model besides noise [1]."""
    colour_aside: float = 3.0
    """Rows up to which a stretch's rows may be off the others' times."""
    least_noise: tuple[float, ...] = (1e-5, 1e-5, 1e-4, 1e-4, 1e-3, 1e-2)
    """Noise below is rounding and the model's steps; pose [m, rad], velocity [m/s], rates [rad/s],
    accelerometer [m/s^2], rotor speed [rad/s]."""

    relevance: tuple[float, float, float] = (0.05, 0.5, 0.025)
    """What does less is no finding: a force [m/s^2], 0.5 % of the weight; a torque over the inertia
    [rad/s^2]; and a drift after a second [m], which is that of such a force."""

    slow_degree: int = 5
    """Degree of the polynomials in which a model's error of a window would show."""
    rotor_knot_excess: float = 1.5
    """Errors of rotor speeds may be this much larger, for what happens between the knots [1]."""
    singular: float = 1e-5
    """A column with less than this of its own next to the others needs Householder's way [1]."""
    fit_rounds: int = 3
    """Gauss-Newton steps of a fit, where no other number of them is given."""
    converged: float = 0.05
    """A fit is done where another round would lower chi-square by less than this [1]."""
    sign_draws: int = 1999
    """Draws of the null: p-values down to 1/2000."""
    folds: int = 5
    """Parts into which windows are dealt; each is left out once."""
    loud_gain: float = 50.0
    """A gain that noise never has: what else explains as much as the best is no chance either."""
    alike_share: float = 0.5
    """Share of the best gain from which a group of columns explains about as much [1]."""
    few_windows: int = 10
    """Signs of fewer windows can be shuffled in too few ways for a p-value of 1 %."""
    name_p_value: float = 0.001
    """Chance of a false name at each step of the search."""
    most_names: int = 4
    """Effects that are named at most."""
    least_name_share: float = 0.003
    """An effect with less than this share of the first one's gain is not named: the fit of the
    first, which is not exact, leaves so much [1]."""
    short_list: int = 5
    """Candidates that are fitted through the whole model at a step."""
    near_share: float = 0.5
    """Candidates whose linear gain is less than this share of the best are not fitted so [1]."""
    rival_chi2: float = 9.0
    """A rival less than this above a name's chi-square (three sigma) cannot be ruled out."""
    rival_share: float = 0.25
    """Nor can one that leaves less than this share of what the name explains, where that is
    little [1]."""
    settle_rounds: int = 3
    """Times that names and rivals are weighed anew."""
    trusted_horizons_s: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Lengths of a window, of which the longest is taken whose slopes can be trusted [s]."""
    trusted_m: float = 0.15
    """Error of position up to which slopes are trusted [m]."""
    trusted_height_share: float = 0.25
    """The same for height, as a share of it: near the ground the air changes with it [1]."""
    trusted_rad: float = 0.25
    """The same for attitude [rad]."""
    bilinear_rounds: int = 6
    """Gauss-Newton steps of a fit of effects of which one acts through another."""
    last_rounds: int = 10
    """Gauss-Newton steps of the last fit of all names: some effects saturate."""
    first_order_chi2: float = 25.0
    """A candidate that is worse than the best by more to first order is not fitted."""
    first_order_share: float = 0.1
    """Nor one that is worse by more than this share besides: large effects are not linear [1]."""
    diverged_m: float = 50.0
    """A simulated window that ends this far from the flight does not count [m]."""
    least_windows: int = 2
    """Windows to fit without which nothing can be left out."""
    integrator_share: float = 0.6
    """Share of a physics step up to which pose and rates may be apart by integration alone [1]."""

    ground_thrust: float = 0.3
    """Share of the weight below which rotors carry nothing: what stands still then stands on the
    ground [1]."""
    ground_speed: float = 0.3
    """Speed below which a vehicle stands still [m/s]."""
    ground_margin_s: float = 1.0
    """Time before and after standing on the ground in which it takes off or lands [s]."""
    least_flights: int = 3
    """Flights from which their means show how trims differ between flights."""
    longest_memory: int = 40
    """Neighbouring moments of a view up to which errors may hang together."""
    least_fast_share: float = 0.5
    """Fast changes that surely show less than this share of a name speak against it [1]."""
    least_view_share: float = 0.03
    """An effect that takes less than this share of a view's squared error is not named [1]."""
    least_inertial_share: float = 0.06
    """The same in flights without a position: what is not known of their pose makes as much [1]."""
    implausible_times: float = 3.0
    """Beyond so many times its usual size an effect is implausible [1]."""
    hopeless_chi2: float = 10.0
    """Squared error a row, in units of the noise, that all numbers of the catalogue together leave:
    beyond it flights are not judged by rollouts of a second, but by their views."""
    hopeless_windows: int = 16
    """Stretches to which all numbers are fitted where by slopes alone so much remains."""
    hopeless_rounds: int = 6
    """Steps of that fit."""
    view_left_share: float = 0.1
    """Share of a view's squared error that a black box may close beyond what was named, before
    something is missing [1]."""
    unexplained_trim: float = 1.5
    """A force that nothing explains counts beyond so many times the flights' own constant offsets:
    attitude and thrust of a log are known no better than these show [1]."""
    unexplained_force: float = 0.5
    """But from here on in any case: an attitude off by 3 degrees, or 5 % of the weight [m/s^2]."""
    least_rotor_gain: float = 0.01
    """Share of the largest gain below which rotors do nothing along an axis [1]."""
    carried_ridge: float = 0.01
    """How strongly what reference flights lack within a flight is held to none, a moment [1]."""
    carried_least: float = 0.1
    """Velocities [m/s] and accelerations [m/s^2, rad/s^2] that vary by less do not count."""
    gain_doubt: float = 0.5
    """Share of a change by which the vehicle file may be wrong along an axis: inertia, arms and the
    rotors' torque are known no better where nobody identified them [1]."""
    spread_freedom: int = 4
    """Degrees of freedom for which the spread of all axes counts next to an axis's own [1]."""
    change_p_value: float = 0.02
    """Chance of a false name of a change, over all candidates and views."""
    change_draws: int = 9999
    """Draws of what chance does to all candidates of a change at once."""
    swing_periods_s: tuple[float, float] = (0.6, 3.5)
    """Periods of pendulums of 0.1 to 3 m [s]."""
    swing_p_value: float = 0.001
    """Chance of a peak in the spectrum, over all periods."""
    swing_share: float = 0.15
    """Share of what the force view leaves that swings at least [1]."""
    swing_driven: float = 0.5
    """Force that is left over the acceleration at the same period, from which it is no error of a
    model that the flight's own motion shows [1]."""
    view_block_s: float = 2.0
    """Stretches of a flight that a view takes for independent [s]."""

    bootstrap_draws: int = 1000
    """Draws of the 95 % intervals of a gap."""
    bootstrap_block: int = 4
    """Neighbouring windows that are drawn together: they start 0.25 s apart and last 1 s."""
    gap_stride_s: float = 0.25
    """From one start to the next of the rollouts that measure the gap [s]."""
    doubt_chi2: float = 25.0
    """Rise of chi-square on held-out flights from which a name is withdrawn (five sigma)."""
    shown_chi2: float = 9.0
    """Fall of chi-square on held-out flights that is expected of a name at its fitted size, from
    which it is withdrawn where none comes (three sigma)."""
    least_next_to_rest: float = 0.5
    """Where the model stays off the noise floor: held-out squared error that a name takes away at
    least, as a share of what stays and is no noise [1]."""
    cells: int = 4
    """Places along x and y between which a force that hangs on the place is drawn."""
    pieces: int = 5
    """Straight pieces of a curve over one number."""
    thrust_reversal: float = 10.0
    """Change of thrust beyond which its direction is all that counts [m/s^3]."""
    colours_s: tuple[float, ...] = (0.3, 0.03)
    """Times for which a random disturbance keeps its direction: a gust's and a rotor's [s]."""
    disturbance_quantiles: tuple[float, ...] = (0.9, 0.5, 0.1)
    """Quantiles of the information along all directions at which a disturbance is seen."""
    informed_share: float = 1e-9
    """Directions with less than this share of the largest information do not count [1]."""
    noise_doubt: float = 0.02
    """Share by which the measured noise power may be wrong [1]."""
    shape_p_value: float = 0.001
    """A shape over the state that chance equals more rarely than this is structure."""
    colour_p_value: float = 1e-4
    """So is energy of a smooth disturbance along an axis that noise gives more rarely."""
    structure: float = 1.15
    """Slow errors above their expectation by this factor are no noise [1]."""
    structure_rotor_input: float = 1.3
    """The same where measured rotor speeds are the input: their noise is known less well [1]."""
    unexplained_share: float = 0.7
    """Where more of the gap is left, what was named does not explain it [1]."""
    wind_lengths_m: tuple[float, float, int] = (0.5, 40.0, 25)
    """Shortest and longest length of turbulence that is tried [m], and how many."""
    wind_intensities: tuple[float, float, int] = (0.02, 8.0, 121)
    """Least and largest intensity that is tried [m/s], and how many."""
    wind_ratio: float = 10.0
    """Log-likelihood ratio to no wind from which there is wind."""
    wind_rival_ratio: float = 8.0
    """A disturbance along the body axes that is better by this log-likelihood is no wind."""
    wind_tail: float = 4.0
    """Standard errors by which the tails of wind's pulls may be above a normal variable's."""
    profile_fall: float = 1.92
    """Fall of the log-likelihood at the ends of a 95 % interval (Wilks 1938)."""
    check_stride_s: float = 0.5
    """From one window to the next where more of them are wanted than the search has [s]."""
    slow_share: float = 0.6
    """Share of the windows, the slowest, that are fitted where the fast ones judge [1]."""
    least_judged: int = 6
    """Windows to fit and to judge there, at least."""


THRESHOLDS = Thresholds()
"""As `suite diagnose` uses them; tuned on flights of MuJoCo that no blind case contains."""
