"""The pixels of an image about the contours of the mask, and how each depends on the edge profile.

Along mask X the expected pattern is a sum of edges, one for each contour that is felt,

    P = P0 + sum_i c_i E_k(d_i),

where d_i is the distance to contour i, positive towards white, k says whether the contour goes
from black to white or back (and whether it runs across X or Y), and c_i is the step of the
fields on either side, weighted with how much of each row of fields the pixel sees. The pattern
is linear in the four profiles E_k, so that neighbouring contours can be taken apart where they
are felt together. Distances follow from the fitted pose: with contours a little off the
pixels' directions they fall between the pixels (slanted edges).

Source: the slanted-edge method, P. D. Burns, Proc. IS&T PICS, 135 (2000), for straight single
edges; the superposition is derived here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.frame import Bounds, prepare_frame
from rasnik.analysis.outliers import estimate_noise, find_outliers
from rasnik.analysis.parameters import State
from rasnik.analysis.pose import Pose
from rasnik.imaging.appearance import Appearance, Camera, surface
from rasnik.imaging.model import MIN_BLUR_PX, expected_image
from rasnik.imaging.profile import TABLE_ORDERS, EdgeTable, edge_table
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.instrument import System
from rasnik.mask import ChessField

__all__ = [
    "KINDS",
    "N_KINDS",
    "Contour",
    "EdgePixels",
    "ModelEdge",
    "edge_pixels",
    "profile_orders",
]

Array = NDArray[np.float64]

#: Profiles, by the axis that the contour lies across and the step towards +X or +Y.
KINDS = ("x black to white", "x white to black", "y black to white", "y white to black")

#: How many profiles there are.
N_KINDS = len(KINDS)

_CLUSTER_PX = 48  # side of the squares between which the scatter is looked at, as for poses
_CLEAR_FIELDS = 0.3  # a corner is no farther left out than this


@dataclass(frozen=True)
class ModelEdge:
    """The fitted model's edge on the sensor, across contours of one axis.

    Attributes
    ----------
    blur_um : float
    shift_um : float
        How far black reaches beyond its nominal edge.
    fourth_um4 : float
        Fourth cumulant of the blur.
    widths_um : tuple of float
        Projections of the sides of the pixel on the normal of the contour.
    field_um : float
        From one contour to the next, along the normal.
    """

    blur_um: float
    shift_um: float
    fourth_um4: float
    widths_um: tuple[float, float]
    field_um: float

    @property
    def sigma_um(self) -> float:
        """Standard deviation of the line spread, pixel included."""
        return float(np.sqrt(self.blur_um**2 + sum(w**2 for w in self.widths_um) / 12))

    @cached_property
    def table(self) -> EdgeTable:
        return edge_table(self.blur_um, self.widths_um, self.fourth_um4)

    def __call__(self, distance_um: Array) -> Array:
        """Edge spread as the image model has it: the shift to first order."""
        edge, slope = profile_orders(self.table, distance_um)[:2]
        return np.asarray(edge - self.shift_um * slope)


@dataclass(frozen=True, eq=False)
class Contour:
    """One contour near every pixel, the e-th from the nearest.

    Attributes
    ----------
    kind : int
        Index in `KINDS`.
    nearest : bool
        Whether it is the nearest of its axis.
    distance_um : ndarray, shape (n,)
        On the sensor, along the normal; positive on the white side.
    step : ndarray, shape (n,)
        Part of the step from black to white that the pixel sees there, 0 to 1.
    """

    kind: int
    nearest: bool
    distance_um: Array
    step: Array


@dataclass(frozen=True, eq=False)
class EdgePixels:
    """Pixels that can be used, with their residuals, light, and contours; n of them.

    Attributes
    ----------
    row, column : ndarray of int, shape (n,)
    residual : ndarray, shape (n,)
        Image minus expected image, grey.
    weight : ndarray, shape (n,)
        1 / variance.
    white : ndarray, shape (n,)
        Expected pattern, 0 black to 1 white.
    amplitude : ndarray, shape (n,)
        Step from black to white at the pixel, grey.
    surface : ndarray, shape (n, 6)
        Monomials of the position, see `rasnik.imaging.appearance.surface`.
    corner : ndarray of int, shape (2, n)
        Index (i, j) of the nearest lattice corner.
    field : ndarray of int, shape (2, n)
        Index (i, j) of the field that the pixel lies on.
    clear : ndarray of bool, shape (n,)
        Not at a corner.
    cluster : ndarray of int, shape (n,)
        Square of 48 x 48 pixels, numbered from 0.
    contours : tuple of Contour
    edges : tuple of ModelEdge
        Across X and across Y.
    noise_known : bool
        Whether the noise is the system's; else it was measured where the image is flat.
    scale : float
    camera : Camera
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    residual: Array
    weight: Array
    white: Array
    amplitude: Array
    surface: Array
    corner: NDArray[np.int64]
    field: NDArray[np.int64]
    clear: NDArray[np.bool_]
    cluster: NDArray[np.int64]
    contours: tuple[Contour, ...]
    edges: tuple[ModelEdge, ModelEdge]
    noise_known: bool
    scale: float
    camera: Camera

    def __len__(self) -> int:
        return len(self.row)

    def select(self, chosen: NDArray[np.bool_]) -> EdgePixels:
        """Some of the pixels."""
        arrays = {
            name: getattr(self, name)[chosen]
            for name in "row column residual weight white amplitude surface clear cluster".split()
        }
        contours = tuple(
            Contour(one.kind, one.nearest, one.distance_um[chosen], one.step[chosen])
            for one in self.contours
        )
        return EdgePixels(
            **arrays,
            corner=self.corner[:, chosen],
            field=self.field[:, chosen],
            contours=contours,
            edges=self.edges,
            noise_known=self.noise_known,
            scale=self.scale,
            camera=self.camera,
        )


def profile_orders(table: EdgeTable, distance: Array) -> Array:
    """E and its derivatives: nearest entry of the table plus Taylor, as the kernels do.

    Returns
    -------
    ndarray, shape (TABLE_ORDERS, n)
    """
    position = np.clip((distance + table.limit) / table.step, 0, len(table.values) - 1)
    nearest = np.rint(position)
    t = (position - nearest) * table.step
    out = np.empty((TABLE_ORDERS, *np.shape(distance)))
    entry = table.values[nearest.astype(np.intp)].astype(np.float64)
    out[-1] = entry[..., -1]
    for order in range(TABLE_ORDERS - 2, -1, -1):
        out[order] = entry[..., order]
        power = np.ones_like(t)
        for k in range(1, TABLE_ORDERS - order):
            power = power * t / k
            out[order] += power * entry[..., order + k]
    return out


def _model_edges(
    projection: Projection, look: Appearance, camera: Camera, field_um: float
) -> tuple[ModelEdge, ModelEdge]:
    pixel = camera.pixel_um
    blur = max(look.blur_um, MIN_BLUR_PX * pixel)
    edges = []
    for gradient in projection.jacobian_at(*camera.centre_um):
        norm = float(np.hypot(*gradient))
        widths = tuple(abs(float(part)) / norm * pixel for part in gradient)
        edges.append(
            ModelEdge(
                blur_um=float(blur),
                shift_um=look.edge_shift_um / norm,
                fourth_um4=float(look.kurtosis * blur**4),
                widths_um=(widths[0], widths[1]),
                field_um=field_um / norm,
            )
        )
    return edges[0], edges[1]


def _field_weights(edge: ModelEdge, offset: Array, gradient: Array, reach: int) -> list[Array]:
    """How much of each of the 2 x reach fields about the nearest contour a pixel sees.

    `offset` in fields, `gradient` in fields per um.
    """
    steps = [np.ones_like(offset)]
    steps += [
        profile_orders(edge.table, (offset - k) / gradient)[0] for k in range(1 - reach, reach)
    ]
    steps.append(np.zeros_like(offset))
    return [first - second for first, second in zip(steps, steps[1:], strict=False)]


def _contours(
    mask: ChessField,
    projection: Projection,
    edges: tuple[ModelEdge, ModelEdge],
    u: Array,
    v: Array,
) -> tuple[NDArray[np.int64], Array, Array, tuple[Contour, ...]]:
    """Nearest corners, offsets from them in fields, distances in um; all contours that are felt."""
    m, field = projection.matrix, mask.field_um
    x, y = projection.to_mask(u, v)
    w = m[2, 0] * u + m[2, 1] * v + 1.0
    position = np.stack([x, y]) / field
    gradient = np.stack(
        [
            np.hypot(m[k, 0] - p * m[2, 0], m[k, 1] - p * m[2, 1]) / w / field
            for k, p in enumerate((x, y))
        ]
    )
    corner = np.floor(position + 0.5).astype(np.int64)
    offset = position - corner
    reach = max(int(np.ceil(edge.table.reach / edge.field_um + 0.5)) for edge in edges)
    low, high = corner.min(axis=1) - reach, corner.max(axis=1) + reach
    fields = mask.fields(int(low[0]), int(high[0]) + 1, int(low[1]), int(high[1]) + 1)
    index = corner - low[:, None]
    found = []
    for axis in (0, 1):
        colours = fields if axis == 0 else fields.T  # [across the axis, along it]
        along, across = index[axis], index[1 - axis]
        weights = _field_weights(edges[1 - axis], offset[1 - axis], gradient[1 - axis], reach)
        for edge in range(1 - reach, reach):
            distance = (offset[axis] - edge) / gradient[axis]
            rising, falling = np.zeros_like(distance), np.zeros_like(distance)
            for side, weight in zip(range(-reach, reach), weights, strict=True):
                here = colours[across + side, along + edge]
                step = here - colours[across + side, along + edge - 1]
                rising += weight * np.maximum(step, 0)
                falling += weight * np.maximum(-step, 0)
            found.append(Contour(2 * axis, edge == 0, distance, rising))
            found.append(Contour(2 * axis + 1, edge == 0, -distance, falling))
    return corner, offset, np.abs(offset) / gradient, tuple(found)


def edge_pixels(
    image: NDArray[np.generic], pose: Pose, system: System, bounds_px: Bounds | None = None
) -> EdgePixels:
    """The pixels about the contours of an analysed image.

    Parameters
    ----------
    image : ndarray, shape (H, W)
    pose : Pose
        As the likelihood analysis found it, with projection and appearance.
    system : System
        Its mask, pitch and noise are used.
    bounds_px : tuple of int, optional
        (left, top, right, bottom), the last ones included.

    Raises
    ------
    ValueError
        If the pose has no projection or appearance, or the image does not go with the system.
    """
    projection, look = pose.projection, pose.appearance
    if projection is None or look is None:
        raise ValueError(
            "the edges need a pose with a fitted image (method 'likelihood'); this one has none"
        )
    mask = system.mask
    if pose.polarity:
        mask = mask.model_copy(update={"polarity": pose.polarity})
    frame, _ = prepare_frame(image, mask, system.pitch_um, system, bounds_px)
    return _gather(frame.image, frame.valid, frame.noise, frame.camera, mask, projection, look)


def _gather(
    image: NDArray[np.float32],
    valid: NDArray[np.uint8],
    noise: tuple[float, float] | None,
    camera: Camera,
    mask: ChessField,
    projection: Projection,
    look: Appearance,
) -> EdgePixels:
    state = State(projection, look)
    kept = find_outliers(image, valid, state, mask, camera, noise)
    law = noise or estimate_noise(image, kept, state, mask, camera)
    scale = projection.similarity()[0]
    edges = _model_edges(projection, look, camera, mask.field_um)
    expected = expected_image(mask, projection, look, camera)
    row, column = np.nonzero(kept)
    u_um, v_um = sensor_grid_um(camera.shape, camera.pixel_um)
    u, v = u_um[column], v_um[row]
    half_u, half_v = camera.half_size_um
    monomials = surface(u / half_u, v / half_v)
    dark, light = monomials @ look.dark, monomials @ look.light
    level = expected[row, column].astype(np.float64)
    corner, offset, distance, contours = _contours(mask, projection, edges, u, v)
    clear = np.zeros(len(row), dtype=bool)
    for edge, away in zip(edges, distance, strict=True):
        clear |= away >= min(edge.table.reach, _CLEAR_FIELDS * edge.field_um)
    _, cluster = np.unique(
        row // _CLUSTER_PX * (camera.shape[1] // _CLUSTER_PX + 1) + column // _CLUSTER_PX,
        return_inverse=True,
    )
    floor = max(law[0], 1e-3 * law[1] * float(np.ptp(level)), 1e-12)
    return EdgePixels(
        row=row,
        column=column,
        residual=image[row, column] - level,
        weight=1 / np.maximum(law[0] + law[1] * level, floor),
        white=(level - dark) / (light - dark),
        amplitude=light - dark,
        surface=monomials,
        corner=corner,
        field=corner - (offset < 0),
        clear=clear,
        cluster=cluster,
        contours=contours,
        edges=edges,
        noise_known=noise is not None,
        scale=scale,
        camera=camera,
    )
