"""Thresholds of all steps of a diagnosis and of its fits, with unit and reason.

Values without a unit are dimensionless. Terms:

- window: a simulated stretch of up to 1 s; a view compares mean forces or torques instead
- gain: fall of chi-square (squared error in noise variances) by an effect, on left-out stretches
- candidate: an effect that the search tries; name: an effect that the search reports
- null: the distribution of a gain if there is no effect
- rotor lag: the time constant with which the rotors follow their commands
- trim: a constant offset of one flight
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of every step, in the order of the steps."""

    most_windows: int = 200
    """Largest number of windows that are fitted; more take longer and add little."""
    most_rotor_windows: int = 100
    """Largest number of windows if measured rotor speeds are the input. Their errors within a
    window are estimated too, which takes twice as long."""
    most_rows: int = 100_000
    """Number of rows of all flights for force and torque above which logs are thinned."""
    longest_hole_s: float = 0.1
    """Rows further apart are a hole. No window and no fit of a rotor lag reaches across it [s]."""
    fitted_loop_share: float = 0.5
    """Largest RMS difference of measured rotor speeds and those by the nominal rate loop, relative
    to the standard deviation of the measured ones. Above it another controller flew, and the
    measured rotor speeds are the input."""
    still_speed: float = 10.0
    """Smaller changes and errors of rotor speeds are ignored [rad/s]."""
    lag_settled_s: float = 0.2
    """Time that is left out of the comparison of rotor speeds after the first row and after each
    hole, until the effect of the unknown initial speeds has decayed [s]."""
    lag_followed_share: float = 0.99
    """Least share of the rotor speeds' variance that commands and a lag must explain. If speeds
    change little, noise of the rates in the commanded speeds resembles a lag."""
    lag_least_flights: int = 3
    """Least number of flights that must show the lag."""
    lag_closed_share: float = 0.25
    """Least share by which another lag lowers the squared error that the vehicle's own lag has."""
    held_out_share: float = 0.2
    """Share of the flights that is held out; at least one flight is."""
    lone_fitted_share: float = 0.7
    """Share of a single flight that is fitted; its end is held out."""
    noise_rows: int = 20
    """Number of neighbouring rows to which a polynomial is fitted, to estimate the noise. The
    residual of the polynomial is noise, since a model's error is smooth."""
    rotor_noise_rows: int = 8
    """The same if measured rotor speeds are the input, since these change faster."""
    noise_degree: int = 3
    """Degree of that polynomial."""
    colour_degree: int = 3
    """Degree of the polynomial that is subtracted from a window before noise is modelled as
    coloured (correlated in time): errors of the start state resemble coloured noise."""
    colour_gain: float = 3.0
    """Least rise of the log-likelihood to model noise as coloured, not white."""
    drift_gain: float = 3.0
    """Least rise of the log-likelihood to include a drift (error of the model) in the noise."""
    colour_aside: float = 3.0
    """Largest difference between the row times of a window and the median row times of all windows,
    in rows. Windows with a larger one are left out of the noise model."""
    least_noise: tuple[float, ...] = (1e-5, 1e-5, 1e-4, 1e-4, 1e-3, 1e-2)
    """Lower limit of the noise of position [m], attitude [rad], velocity [m/s], rates [rad/s],
    accelerometer [m/s^2] and rotor speed [rad/s]. Rounding and the model's steps cause as much."""
    command_spacing_s: float = 0.012
    """Rows of commands further apart than this may lack commands in between [s]. Controllers give
    commands at 100 Hz or more."""
    lacking_share: float = 0.05
    """Share above which commands are lacking (lower end of its interval): 0 if each logged command
    acts until the next, 1 if others act half-way."""
    held_share: float = 0.4
    """Share up to which each command certainly acts until the next (upper end of its interval)."""

    relevance: tuple[float, float, float] = (0.05, 0.5, 0.025)
    """Sizes below which an effect is not reported: force per mass [m/s^2] (0.5 % of the weight),
    angular acceleration [rad/s^2], and position error after 1 s [m], which such a force causes."""

    visible_sigma: float = 4.0
    """Size of an effect that flights show clearly, in standard errors."""
    slow_degree: int = 5
    """Degree of the polynomials over a window. Their part of the residual (the slow errors)
    measures the model's error."""
    rotor_knot_excess: float = 1.5
    """Factor on the estimated errors of rotor speeds. The errors are modelled at knots in time, and
    the factor accounts for errors between them."""
    singular: float = 1e-5
    """Smallest share of a column that is independent of the other columns. Below it, the
    least-squares problem is solved by Householder's QR."""
    fit_rounds: int = 3
    """Gauss-Newton steps of a fit for which no other number is given."""
    converged: float = 0.05
    """A fit ends if another step would lower chi-square by less than this."""
    sign_draws: int = 1999
    """Number of draws of the null, by random signs of the windows: p-values down to 1/2000."""
    folds: int = 5
    """Number of parts of the windows in cross-validation; each part is left out once."""
    strong_gain: float = 50.0
    """Gain that noise never reaches; candidates nearly as good as the best are then real, too."""
    few_windows: int = 12
    """Least number of windows for a permutation test. The signs of fewer windows have too few
    permutations for a p-value of `name_p_value`."""
    name_p_value: float = 0.001
    """Probability of a false name at each step of the search."""
    most_names: int = 4
    """Largest number of named effects."""
    least_name_share: float = 0.003
    """Least gain of a further effect, as a share of the first effect's gain. The fit of the first
    effect is not exact and has a residual of this size."""
    short_list: int = 5
    """Number of candidates that are fitted with the nonlinear model at each step of the search."""
    alike_share: float = 0.5
    """Share of the best gain from which a group of columns explains about as much as the best."""
    near_share: float = 0.5
    """Least linear gain of the candidates on the short list, as a share of the best gain."""
    rival_chi2: float = 9.0
    """Rise of chi-square above the named effect's for an alternative ("rival"; three sigma)."""
    rival_share: float = 0.25
    """The same as a share of the explained chi-square; the smaller limit counts."""
    settle_rounds: int = 3
    """Largest number of rounds in which named effects and alternatives are compared again."""
    trusted_horizons_s: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Allowed lengths of a window, of which the longest valid one is used [s]."""
    trusted_m: float = 0.15
    """Position error up to which the linearisation is valid [m]."""
    trusted_height_share: float = 0.25
    """Height error up to which the linearisation is valid, as a share of the height: the ground
    effect depends on the height."""
    trusted_rad: float = 0.25
    """Attitude error up to which the linearisation is valid [rad]."""
    bilinear_rounds: int = 6
    """Gauss-Newton steps of a fit of two effects if one acts through the other (wind by drag)."""
    last_rounds: int = 10
    """Gauss-Newton steps of the last fit of all named effects: some effects saturate."""
    first_order_chi2: float = 25.0
    """A candidate is not fitted with the nonlinear model if its linear chi-square exceeds the best
    candidate's by more than this."""
    first_order_share: float = 0.1
    """Share of the best gain that is added to this limit: large effects are not linear."""
    diverged_m: float = 50.0
    """A simulated window that ends further from the flight has diverged and is left out [m]."""
    least_windows: int = 2
    """Least number of windows to fit; cross-validation leaves some out."""
    integrator_share: float = 0.6
    """Largest delay between pose and rates that an integrator explains, in its steps."""

    ground_thrust: float = 0.3
    """Thrust, as a share of the weight, below which a vehicle at rest is on the ground."""
    ground_speed: float = 0.3
    """Speed below which a vehicle is at rest [m/s]."""
    ground_rate: float = 0.3
    """Body rate below which a vehicle is at rest, if its speed is unknown [rad/s]."""
    ground_margin_s: float = 1.0
    """Time before and after rest on the ground that counts as take-off and landing [s]. If the
    speed is unknown, it is also the shortest rest."""
    least_view_s: float = 1.0
    """Least flight time to fit, and least flight time to hold out, for force and torque [s]."""
    least_flights: int = 3
    """Least number of flights from which the spread of trims between flights is estimated."""
    longest_memory: int = 40
    """Largest time difference in the autocorrelation of a view's errors, in windows of the view."""
    least_fast_share: float = 0.5
    """Least share of an effect that fast changes of the error confirm. An effect with a
    significantly smaller share is rejected."""
    least_view_share: float = 0.03
    """Least share of a view's squared error that a named effect explains."""
    least_inertial_share: float = 0.06
    """The same for flights without a position: the uncertainty of their pose has this size."""
    implausible_times: float = 3.0
    """An effect larger than this many times its usual size is implausible."""
    hopeless_chi2: float = 10.0
    """Largest mean squared error, in noise variances, after a fit of all effects together. If it is
    exceeded, force and torque are used instead of rollouts of 1 s."""
    hopeless_m: float = 0.01
    """Largest RMS error of positions in rollouts of 1 s after that fit, whatever the noise [m]. A
    force below the threshold of relevance causes as much."""
    hopeless_windows: int = 16
    """Windows of that fit with the nonlinear model, after a linear fit above the limit."""
    hopeless_rounds: int = 6
    """Number of Gauss-Newton steps of that fit."""
    view_left_share: float = 0.1
    """Largest share of a view's squared error that a black box explains beyond the named effects.
    If it is exceeded, an effect is missing."""
    unexplained_trim: float = 1.5
    """An unexplained force is reported only above this many times the flights' constant offsets,
    which show the accuracy of attitude and thrust in a log."""
    unexplained_force: float = 0.5
    """Upper limit of it: 3 degrees of attitude, or 5 % of the weight [m/s^2]."""
    least_rotor_gain: float = 0.01
    """Smallest influence of the rotors along an axis that counts, as a share of their largest
    influence along any axis."""
    carried_ridge: float = 0.01
    """Ridge weight, for each mean, of the regression that predicts the reference flights' residual
    in the flights after the change."""
    carried_least: float = 0.1
    """Least standard deviation of that regression's inputs [m/s, m/s^2, rad/s^2]."""
    gain_error: float = 0.5
    """Relative error of a change along an axis that errors of the vehicle file cause: inertia, arms
    and rotor torque have such errors if they were not identified."""
    spread_freedom: int = 4
    """Weight of the spread over all axes, relative to an axis's own, in degrees of freedom."""
    change_p_value: float = 0.02
    """Probability of a false name of a change, over all candidates and views."""
    change_draws: int = 9999
    """Number of draws of the null of a change, for all candidates together."""
    swing_p_value: float = 0.001
    """Probability of a false peak in the spectrum of the force residual, over all periods."""
    swing_share: float = 0.15
    """Least share of the force residual's power that oscillates at the period of the peak."""
    swing_driven: float = 0.5
    """Least ratio of residual force to measured acceleration at that period. Below it, the flight's
    motion may excite a model error instead."""
    view_block_s: float = 2.0
    """Length of blocks whose errors count as independent in a view [s]."""

    gap_stride_s: float = 0.25
    """Time between the starts of the rollouts that measure the gap [s]."""
    refuting_chi2: float = 25.0
    """Rise of chi-square on held-out flights above which a name is withdrawn (five sigma)."""
    shown_chi2: float = 9.0
    """Expected fall of chi-square on held-out flights (three sigma) above which a name has to lower
    it. A name that does not is withdrawn."""
    least_next_to_rest: float = 0.5
    """Least fall of the held-out squared error by a name, as a share of the residual above the
    noise, if that residual is significant."""
    shape_p_value: float = 0.001
    """Largest p-value with which a function of the state counts as structure in the residual."""
    colour_p_value: float = 1e-4
    """Largest p-value with which a smooth disturbance along an axis counts as structure."""
    structure: float = 1.15
    """Ratio of the energy of slow errors to its expectation, above which they are not noise."""
    structure_rotor_input: float = 1.3
    """The same with measured rotor speeds as the input, or if the log lacks commands."""
    above_noise: float = 1.5
    """Remaining errors above this many noise floors are reported, even if they show no structure.
    Errors of unknown rotor speeds alone may reach 1.3."""
    unexplained_share: float = 0.7
    """Largest remaining share of the gap for the verdict `partly`; above it, it is `unknown`."""
    wind_ratio: float = 10.0
    """Least rise of the log-likelihood by wind, compared with no wind."""
    wind_rival_ratio: float = 8.0
    """Wind is rejected if a disturbance along the body axes has a log-likelihood higher by this."""
    wind_tail: float = 4.0
    """Largest excess of the fitted wind's fourth moment over a normal one, in standard errors."""
    profile_fall: float = 1.92
    """Fall of the log-likelihood at the ends of a 95 % interval (Wilks 1938)."""


THRESHOLDS = Thresholds()
"""The defaults of `suite diagnose`, tuned on MuJoCo flights that no blind case contains."""
