"""Where all bodies of an installation stand, from all readings at once.

Weighted least squares with the exact model of `rasnik.geometry.network`. Motions that nothing
measures (`rasnik.geometry.observability`) are held within the range that the installation states,
as if measured to be zero with that as the error: whatever they do to the rest is then part of the
errors of the rest, and they themselves are reported as unmeasured, without a number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rasnik.geometry.installation import VALUES, Installation
from rasnik.geometry.network import Network
from rasnik.geometry.observability import LEAKAGE, name_motions, unmeasured_space
from rasnik.geometry.observations import Readings, contradictions
from rasnik.geometry.outliers import Snooping, snoop
from rasnik.geometry.rigid import DOFS, UM_PER_MM
from rasnik.geometry.sagitta import sagittas
from rasnik.geometry.solution import Adjustment, Check, Outlier

__all__ = ["Adjustment", "adjust", "capability"]

Array = NDArray[np.float64]

# Of the last step in standard deviations; beyond it the solution still moves.
_CONVERGED = 1e-3
_POLISHING_STEPS = 3
_TOLERANCE = 1e-6
# Fewer degrees of freedom say nothing about chi2.
_LEAST_NDF = 0.5
# Ranges beyond which a motion contradicts what was believed.
_BEYOND = 3.0
# Misfit of a trial that is to be turned down, in standard deviations.
_INTERRUPTED = 1e100
# A posterior error within this factor of the prior comes from the prior.
_FROM_PRIOR = 0.99


def adjust(
    network: Network | Installation,
    readings: Readings,
    reference: Readings | None = None,
    *,
    reject: bool = False,
) -> Adjustment:
    """Motions of all bodies from all readings.

    Parameters
    ----------
    network : Network or Installation
    readings : Readings
    reference : Readings, optional
        Read when everything was in its nominal place: motions are told from then on, and the
        origins of masks do not matter. By default readings are absolute.
    reject : bool
        Leave out values that are named as wrong, one at a time, and those alone for which no
        other reading may be wrong in their place.

    Returns
    -------
    Adjustment

    Raises
    ------
    ValueError
        If no reading can be used.

    Notes
    -----
    Errors of a difference are those of both readings in quadrature.
    """
    network = network if isinstance(network, Network) else Network(network)
    observed, sigmas, problems = _observed(network, readings, reference)
    used = np.isfinite(observed) & np.isfinite(sigmas)
    if not used.any():
        why = "; ".join(problems) or "none has a known error"
        raise ValueError(f"there is no reading that can be used: {why}")
    first = _Fit(network, observed, sigmas, used)
    outliers, good = _find_outliers(first, reject)
    final = _Fit(network, observed, sigmas, good) if (good != used).any() else first
    return _result(final, used, outliers, problems)


def capability(network: Network | Installation) -> Adjustment:
    """What an installation can measure: errors and unmeasured motions, without any reading.

    Returns
    -------
    Adjustment
        For bodies near their nominal places and one reading of each Rasnik; motions, residuals
        and chi2 are NaN.

    Raises
    ------
    ValueError
        If the error of no value is known.
    """
    network = network if isinstance(network, Network) else Network(network)
    sigmas = np.array([network.installation.value_sigmas(r) for r in network.installation.rasniks])
    used = np.isfinite(sigmas)
    if not used.any():
        raise ValueError(
            f"{network.installation.name} states no error of any reading: give sigma_x_um, "
            "sigma_y_um, ... or a system, in [defaults] or for each Rasnik"
        )
    fit = _Fit(network, np.full(sigmas.shape, np.nan), sigmas, used)
    return _result(fit, used, [], [])


def _observed(
    network: Network, readings: Readings, reference: Readings | None
) -> tuple[Array, Array, list[str]]:
    """Readings as if the origins of all masks were those of the installation, with errors."""
    rasniks = network.installation.rasniks

    def errors(of: Readings) -> Array:
        pairs = zip(rasniks, of.sigmas, strict=True)
        return np.array([network.installation.value_sigmas(r, own) for r, own in pairs])

    observed, sigmas = readings.values.copy(), errors(readings)
    problems = list(readings.problems)
    if reference is None:
        problems += contradictions(network, readings, np.isfinite(sigmas))
    else:
        observed += network.nominal - reference.values
        sigmas = np.hypot(sigmas, errors(reference))
        against = contradictions(network, reference, np.zeros_like(sigmas, dtype=bool))
        problems += [f"reference: {text}" for text in (*reference.problems, *against)]
    nameless = [
        f"{value} of {rasnik.name}"
        for k, rasnik in enumerate(rasniks)
        for v, value in enumerate(VALUES)
        if np.isfinite(observed[k, v])
        and not np.isfinite(sigmas[k, v])
        and value in (network.installation.accuracy(rasnik).measures or VALUES)
    ]
    if nameless:
        problems.append(f"not used, as the error is not known: {', '.join(nameless)}")
    return observed, sigmas, problems


class _Fit:
    """The solution for one choice of readings; parameters are counted in ranges.

    Rows: readings used, priors, unmeasured motions, all over their errors. Without observed
    values it is the linear problem at the nominal places.
    """

    def __init__(
        self, network: Network, observed: Array, sigmas: Array, used: NDArray[np.bool_]
    ) -> None:
        installation = network.installation
        self.network, self.observed, self.sigmas, self.used = network, observed, sigmas, used
        self.free = np.array([body.free for body in installation.bodies])
        prior = np.array([body.prior_sigma for body in installation.bodies])[self.free]
        span = [UM_PER_MM * installation.range_mm] * 3 + [installation.range_rad] * 3
        self.ranges = np.broadcast_to(span, self.free.shape)[self.free]
        self.priors = np.flatnonzero(np.isfinite(prior))
        self.prior_sigmas = prior[self.priors]
        still = np.zeros(len(self.ranges))
        self.space = np.zeros((len(self.ranges), 0))
        self.space = unmeasured_space(self.slopes(still))
        self.parameters = still
        self.converged = True
        if np.isfinite(observed[used]).all():
            self._solve()
        self.left, self.sizes, self.right = np.linalg.svd(
            self.slopes(self.parameters), full_matrices=False
        )

    @property
    def n_readings(self) -> int:
        return int(self.used.sum())

    def motions(self, parameters: Array) -> Array:
        motions = np.zeros(self.free.shape)
        motions[self.free] = parameters * self.ranges
        return motions

    def misfits(self, parameters: Array) -> Array:
        """Computed minus observed, over errors."""
        difference = self.network.values(self.motions(parameters)) - self.observed
        # half a turn cannot be told from none
        difference[:, 3] -= np.pi * np.round(difference[:, 3] / np.pi)
        return np.concatenate(
            [
                (difference / self.sigmas)[self.used],
                (parameters * self.ranges)[self.priors] / self.prior_sigmas,
                self.space.T @ parameters,
            ]
        )

    def slopes(self, parameters: Array) -> Array:
        """Derivatives of `misfits`, shape (rows, n)."""
        jacobian = self.network.jacobian(self.motions(parameters))
        rows = (jacobian[..., self.free] * self.ranges / self.sigmas[..., None])[self.used]
        priors = np.zeros((len(self.priors), len(self.ranges)))
        priors[np.arange(len(self.priors)), self.priors] = (
            self.ranges[self.priors] / self.prior_sigmas
        )
        return np.concatenate([rows, priors, self.space.T])

    def _solve(self) -> None:
        from scipy.optimize import least_squares

        if not len(self.ranges):
            return
        found = least_squares(
            self._tried, self.parameters, self.slopes, method="lm",
            ftol=_TOLERANCE, xtol=_TOLERANCE, gtol=_TOLERANCE,
        )  # fmt: skip
        self.parameters, self.converged = found.x, False
        try:
            for _ in range(_POLISHING_STEPS):  # the last digits, which a sum of squares hides
                slopes = self.slopes(self.parameters)
                step = np.linalg.lstsq(slopes, -self.misfits(self.parameters))[0]
                self.misfits(self.parameters + step)
                self.parameters = self.parameters + step
        except ValueError:  # the step interrupts a light path
            return
        self.converged = bool(np.linalg.norm(slopes @ step) < _CONVERGED)

    def _tried(self, parameters: Array) -> Array:
        """`misfits` of a trial; enormous if a light path is interrupted."""
        try:
            return self.misfits(parameters)
        except ValueError:
            rows = self.n_readings + len(self.priors) + self.space.shape[1]
            return np.full(rows, _INTERRUPTED)

    def covariance(self) -> Array:
        """Of the free degrees of freedom, in um and rad."""
        root = (self.right.T / self.sizes) * self.ranges[:, None]
        return np.asarray(root @ root.T)

    def measured(self) -> NDArray[np.bool_]:
        """Of the free degrees of freedom: those with next to no share in unmeasured motions."""
        return np.asarray(np.linalg.norm(self.space, axis=1) <= LEAKAGE)

    def chi2(self) -> float:
        """Of readings and priors; NaN without readings."""
        known = self.n_readings + len(self.priors)
        return float(np.sum(self.misfits(self.parameters)[:known] ** 2))

    def ndf(self) -> float:
        """What readings and priors are not used up by the motions.

        A whole number, unless the motions that are found make readings sensitive to one that is
        unmeasured at the nominal places: then part of a reading goes into that.
        """
        known = self.n_readings + len(self.priors)
        return round(known - float(np.sum(self.left[:known] ** 2)), 6)

    def snooping(self) -> Snooping:
        tested = np.arange(len(self.left)) < self.n_readings + len(self.priors)
        return snoop(self.left, -self.misfits(self.parameters), tested)

    def row_names(self) -> list[tuple[str, str]]:
        """(Rasnik, value) of readings, (body, degree of freedom) of priors."""
        places = np.argwhere(self.free)[self.priors]
        return [
            *((self.network.rasniks[k], VALUES[v]) for k, v in np.argwhere(self.used)),
            *((f"the prior of {self.network.bodies[b]}", DOFS[d].split("_")[0]) for b, d in places),
        ]


def _find_outliers(first: _Fit, reject: bool) -> tuple[list[Outlier], NDArray[np.bool_]]:
    """Values that contradict the others, found one at a time; and which are to be used."""
    outliers: list[Outlier] = []
    fit, searched, good = first, first.used.copy(), first.used.copy()
    while True:
        tests = fit.snooping()
        if tests.worst is None:
            return outliers, good
        names, scale = fit.row_names(), np.append(fit.sigmas[fit.used], fit.prior_sigmas)
        rasnik, value = names[tests.worst]
        is_reading = tests.worst < fit.n_readings
        alone = is_reading and not tests.alternatives
        redundancy = tests.redundancy[tests.worst]
        outliers.append(
            Outlier(
                rasnik,
                value,
                float(tests.w[tests.worst]),
                float(tests.w[tests.worst] / np.sqrt(redundancy) * scale[tests.worst]),
                float(scale[tests.worst] / np.sqrt(redundancy)),
                tuple(f"{names[k][1]} of {names[k][0]}" for k in tests.alternatives),
                left_out=reject and alone,
            )
        )
        if not is_reading:
            return outliers, good
        index = tuple(np.argwhere(fit.used)[tests.worst])
        searched[index] = False
        good[index] = not (reject and alone)
        if not searched.any():
            return outliers, good
        fit = _Fit(first.network, first.observed, first.sigmas, searched)


def _result(
    fit: _Fit, offered: NDArray[np.bool_], outliers: list[Outlier], problems: list[str]
) -> Adjustment:
    from scipy.stats import chi2

    network, free, has_data = fit.network, fit.free, bool(np.isfinite(fit.observed[fit.used]).all())
    estimate, known = fit.motions(fit.parameters), fit.measured()
    covariance = fit.covariance()
    sagitta = sagittas(network, estimate, free, covariance, fit.space, fit.ranges, has_data)
    sigma = np.sqrt(np.diag(covariance))
    from_prior = np.zeros(len(sigma), dtype=bool)
    from_prior[fit.priors] = sigma[fit.priors] > _FROM_PRIOR * fit.prior_sigmas

    full = np.zeros((free.size, free.size))
    covariance[~known, :] = covariance[:, ~known] = np.nan
    where = np.flatnonzero(free.ravel())
    full[np.ix_(where, where)] = covariance
    measured, prior = np.zeros_like(free), np.zeros_like(free)
    measured[free], prior[free] = known, from_prior
    motions = (
        np.where(measured | ~free, estimate, np.nan) if has_data else np.full(free.shape, np.nan)
    )

    squares, ndf = fit.chi2(), fit.ndf()
    checks = _checks(fit, offered)
    return Adjustment(
        network,
        motions,
        full,
        free,
        measured,
        prior,
        tuple(name_motions(network, free, fit.space, fit.ranges, np.asarray(fit.used.any(axis=1)))),
        squares,
        ndf,
        float(chi2.sf(squares, ndf)) if ndf >= _LEAST_NDF else np.nan,
        checks,
        tuple(outliers),
        sagitta,
        (*problems, *_beyond_range(fit)),
        fit.converged,
        estimate,
    )


def _beyond_range(fit: _Fit) -> list[str]:
    """Motions that nobody believed in: readings then mean something else."""
    far = np.flatnonzero(np.abs(fit.parameters) > _BEYOND)
    if not len(far):
        return []
    installation = fit.network.installation
    worst = far[np.argmax(np.abs(fit.parameters[far]))]
    b, d = np.argwhere(fit.free)[worst]
    value = fit.parameters[worst] * fit.ranges[worst]
    told = f"{value / UM_PER_MM:.4g} mm along" if d < 3 else f"{1e3 * value:.4g} mrad about"
    believed = (
        f"{installation.range_mm:g} mm" if d < 3 else f"{1e3 * installation.range_rad:g} mrad"
    )
    return [
        f"{fit.network.bodies[b]} would have moved by {told} {'xyz'[d % 3]}, but is believed to "
        f"stay within {believed}: give reference readings, or the mask.point_um of every Rasnik, "
        f"or a larger range"
    ]


def _checks(fit: _Fit, offered: NDArray[np.bool_]) -> tuple[Check, ...]:
    tests = fit.snooping()
    misfits = -fit.misfits(fit.parameters)
    scale = np.append(fit.sigmas[fit.used], fit.prior_sigmas)
    found = [
        Check(
            *names,
            residual=float(misfits[row] * scale[row]),
            sigma=float(scale[row]),
            redundancy=float(tests.redundancy[row]),
            w=float(tests.w[row]),
            detectable=float(tests.detectable[row] * scale[row]),
        )
        for row, names in enumerate(fit.row_names())
    ]
    left_out = offered & ~fit.used
    if left_out.any():
        difference = fit.observed - fit.network.values(fit.motions(fit.parameters))
        difference[:, 3] -= np.pi * np.round(difference[:, 3] / np.pi)
        for k, v in np.argwhere(left_out):
            found.append(
                Check(
                    fit.network.rasniks[k], VALUES[v], float(difference[k, v]),
                    float(fit.sigmas[k, v]), np.nan, np.nan, np.nan, used=False,
                )
            )  # fmt: skip
    return tuple(found)
