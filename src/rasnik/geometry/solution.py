"""What an adjustment finds: motions of bodies with errors, checks of readings, what is wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.geometry.network import Network
from rasnik.geometry.observability import Unmeasured
from rasnik.geometry.rigid import DOFS
from rasnik.geometry.sagitta import SagittaResult

__all__ = ["LEAST_PROBABILITY", "Adjustment", "Check", "Outlier"]

Array = NDArray[np.float64]

#: Of chi2, below which readings contradict each other.
LEAST_PROBABILITY = 1e-3


@dataclass(frozen=True)
class Check:
    """One value of one reading against all others.

    Attributes
    ----------
    rasnik : str
        Name; of a body for its prior.
    value : str
        ``x``, ``y``, ``scale``, ``theta``, or the degree of freedom that has a prior.
    residual, sigma : float
        Observed minus computed and the error of the reading: um, rad or a ratio.
    redundancy : float
        0 (nothing checks it) to 1.
    w : float
        Normalised residual; NaN where nothing checks it.
    detectable : float
        Smallest error of this value that is named with 80 % chance; infinite where nothing
        checks it.
    used : bool
        False if it was left out as wrong.
    """

    rasnik: str
    value: str
    residual: float
    sigma: float
    redundancy: float
    w: float
    detectable: float
    used: bool = True

    @property
    def label(self) -> str:
        """``x of A1``."""
        return f"{self.value} of {self.rasnik}"


@dataclass(frozen=True)
class Outlier:
    """A value that contradicts the others.

    Attributes
    ----------
    rasnik, value : str
    w : float
        Its normalised residual when it was found, the ones before it left out.
    error, sigma : float
        By how much it seems to be wrong, and how well that is known: um, rad or a ratio.
    alternatives : tuple of str
        Others, one of which may be the wrong one in its place.
    left_out : bool
        Whether the result is without it.
    """

    rasnik: str
    value: str
    w: float
    error: float
    sigma: float
    alternatives: tuple[str, ...]
    left_out: bool


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What the readings say about the bodies.

    Attributes
    ----------
    network : Network
    motions : ndarray, shape (bodies, 6)
        Translations (um) and rotation vectors (rad) from the nominal places (or from those of the
        reference), along and about each body's own axes. 0 where held, NaN where unmeasured.
    covariance : ndarray, shape (6 bodies, 6 bodies)
        0 where held, NaN where unmeasured.
    free, measured, from_prior : ndarray of bool, shape (bodies, 6)
        What can move; what the readings measure; what is known, but from its prior alone.
    unmeasured : tuple of Unmeasured
        All motions that no reading shows, the simplest names for them.
    chi2, ndf, probability : float
        Weighted squares of all residuals, degrees of freedom, and the chance of a larger chi2 if
        everything is as described. Not always a whole number of degrees of freedom: turned bodies
        let readings feel a little of motions that are otherwise unmeasured.
    checks : tuple of Check
    outliers : tuple of Outlier
        In the order in which they were found.
    sagittas : tuple of SagittaResult
    problems : tuple of str
        What could not be used, or cannot be believed.
    converged : bool
    estimate : ndarray, shape (bodies, 6)
        The solution that residuals belong to, unmeasured motions near zero; for drawing.
    """

    network: Network
    motions: Array
    covariance: Array
    free: NDArray[np.bool_]
    measured: NDArray[np.bool_]
    from_prior: NDArray[np.bool_]
    unmeasured: tuple[Unmeasured, ...]
    chi2: float
    ndf: float
    probability: float
    checks: tuple[Check, ...]
    outliers: tuple[Outlier, ...]
    sagittas: tuple[SagittaResult, ...]
    problems: tuple[str, ...] = ()
    converged: bool = True
    estimate: Array = field(default_factory=lambda: np.zeros((0, 6)))

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the motions, shape (bodies, 6)."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 6)

    @property
    def consistent(self) -> bool:
        """Whether chi2 is likely, nothing is named as wrong, and the solution converged."""
        likely = not self.probability < LEAST_PROBABILITY
        return self.converged and likely and not self.outliers

    @property
    def complete(self) -> bool:
        """Whether every free degree of freedom is measured and every reading was used."""
        return not self.unmeasured and not self.problems

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain numbers and texts; None stands for what is not known."""
        bodies = {}
        for b, name in enumerate(self.network.bodies):
            bodies[name] = {
                dof: {
                    "value": _plain(self.motions[b, d]),
                    "sigma": _plain(self.sigmas[b, d]),
                    "state": self.state(b, d),
                }
                for d, dof in enumerate(DOFS)
            }
        return {
            "installation": self.network.installation.name,
            "bodies": bodies,
            "unmeasured": [
                {"words": u.words, "kind": u.kind, "motion": u.motion} for u in self.unmeasured
            ],
            "chi2": _plain(self.chi2),
            "ndf": self.ndf,
            "probability": _plain(self.probability),
            "converged": self.converged,
            "sagittas": [one.as_dict() for one in self.sagittas],
            "outliers": [
                vars(one) | {"alternatives": list(one.alternatives)} for one in self.outliers
            ],
            "readings": [{k: _plain(v) for k, v in vars(one).items()} for one in self.checks],
            "problems": list(self.problems),
            "covariance_order": [f"{b}.{dof}" for b in self.network.bodies for dof in DOFS],
            "covariance": [[_plain(v) for v in row] for row in self.covariance.tolist()],
        }

    def state(self, body: int, dof: int) -> str:
        """``held``, ``measured``, ``prior`` or ``unmeasured``."""
        if not self.free[body, dof]:
            return "held"
        if not self.measured[body, dof]:
            return "unmeasured"
        return "prior" if self.from_prior[body, dof] else "measured"


def _plain(value: Any) -> Any:
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
