"""``rasnik geometry``: what motions of mask, lens and sensor do to a reading, and back."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, load, numbers, output
from rasnik.cli.files import PlotOption, check_outputs, written
from rasnik.cli.predict import SetOption

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rasnik.geometry.air import Air
    from rasnik.geometry.inverse import Displacement
    from rasnik.geometry.reading import Reading
    from rasnik.geometry.three_points import ThreePoints
    from rasnik.instrument import System

__all__ = ["geometry_command"]

#: Readings as shown: name, factor from um, ratio or rad, unit.
_SHOWN = (("x", 1e3, "nm"), ("y", 1e3, "nm"), ("S", 1e6, "1e-6"), ("theta_z", 1e6, "µrad"))
_DEFAULT_FIND = "lens_x,lens_y,lens_z,mask_turn_z"


def geometry_command(
    system_name: Annotated[
        str | None,
        typer.Argument(metavar="SYSTEM", help="Shipped system or TOML file.", show_default=False),
    ] = None,
    overrides: SetOption = None,
    mask_lens_mm: Annotated[
        float | None, typer.Option("--mask-lens-mm", metavar="A", help="Distance mask - lens.")
    ] = None,
    lens_sensor_mm: Annotated[
        float | None, typer.Option("--lens-sensor-mm", metavar="B", help="Distance lens - sensor.")
    ] = None,
    pivot_mm: Annotated[
        float | None,
        typer.Option(
            "--pivot-mm", metavar="Z", help="Where the camera turns, from the mask; at the lens."
        ),
    ] = None,
    reading: Annotated[
        str | None,
        typer.Option(
            "--reading", metavar="X,Y[,S,THETA]", help="A reading to invert: um, um, 1, rad."
        ),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            "--reference",
            metavar="X,Y[,THETA]",
            help="What was read when all stood in place: um, um, rad. By default 0, 0 and the "
            "system's theta.",
        ),
    ] = None,
    find: Annotated[
        str, typer.Option("--find", metavar="MOTION,...", help="What has moved.")
    ] = _DEFAULT_FIND,
    kelvin_per_m: Annotated[
        float, typer.Option("--kelvin-per-m", help="Temperature gradient across the light.")
    ] = 1.0,
    celsius: Annotated[float, typer.Option("--celsius", help="Temperature of the air.")] = 20.0,
    pressure_hpa: Annotated[float, typer.Option("--pressure-hpa", help="0: vacuum.")] = 1013.25,
    humidity: Annotated[float, typer.Option("--humidity", help="Relative, 0 to 1.")] = 0.5,
    plot: PlotOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON.")] = False,
) -> None:
    """Say what each motion of mask, lens and sensor does to a reading, and invert a reading.

    Distances are those of the system, or given. The smallest motion that one image shows follows
    from the bound of rasnik predict, if the system states its noise. Exit status 1: the motions
    asked for do not explain the reading.

    [bold]Examples[/]

    rasnik geometry solidras -o geometry.png

    rasnik geometry --mask-lens-mm 2000 --lens-sensor-mm 3000 --kelvin-per-m 0.5

    rasnik geometry solidras --reference 4000,5000 --reading 4012.5,4998,1.0002,0.0001
    """
    check_outputs([plot] if plot else None, (".png", ".pdf", ".svg"))
    system = load(system_name, overrides or ()) if system_name is not None else None
    if system is None and overrides:
        fail("--set changes a value of a system: name the system.")
    if system is None and None in (mask_lens_mm, lens_sensor_mm):
        fail("Give --mask-lens-mm and --lens-sensor-mm, or a system.")
    if not math.isfinite(kelvin_per_m):
        fail(f"--kelvin-per-m = {kelvin_per_m:g} is not a finite number.")

    from rasnik.geometry.air import Air
    from rasnik.geometry.three_points import three_points

    try:
        built = _as_built(reference, pivot_mm)
        instrument = three_points(mask_lens_mm, lens_sensor_mm, system=system, **built)
    except ValueError as error:
        fail(_with_options(str(error)))
    wavelength = system.optics.wavelength_nm if system is not None else None
    no_air = ""
    try:
        air = Air(celsius + 273.15, pressure_hpa, humidity, wavelength or 550.0)
    except ValueError as error:  # the rest does not need the air
        air, no_air = None, f"{error}".removeprefix("air: ")
    covariance = _bound_covariance(system)
    found, given = None, None if reading is None else _given(instrument, reading)
    if given is not None:
        try:
            found = _invert(instrument, given, find, covariance)
        except (ValueError, KeyError) as error:
            fail(f"{error.args[0]}.")
        at = given[0]
        sagitta = instrument.sagitta(at.x_um, at.y_um, at.scale, covariance)
    if as_json:
        document = _document(instrument, system, covariance, air, no_air, kelvin_per_m)
        if found is not None:
            document |= {"displacement": found.as_dict(), "sagitta_um": sagitta[0].tolist()}
        typer.echo(json.dumps(document, indent=2))
    else:
        _print(instrument, system, covariance)
        if found is not None:
            _print_inverse(found, *sagitta)
        _print_air(instrument, air, no_air, kelvin_per_m, wavelength is None)
    if plot is not None:
        from rasnik.report.geometry import draw_geometry

        written(plot, lambda: draw_geometry(instrument, plot), quiet=as_json)
    if found is not None and not _explains(found):
        raise typer.Exit(1)


def _as_built(reference: str | None, pivot_mm: float | None) -> dict[str, Any]:
    built: dict[str, Any] = {} if pivot_mm is None else {"pivot_mm": pivot_mm}
    if reference is not None:
        values = numbers(reference, "--reference", "X,Y,THETA", least=2)
        built |= dict(zip(("x_um", "y_um", "theta_rad"), values, strict=False))
    return built


def _with_options(sentence: str) -> str:
    """Names of arguments as those of options."""
    for name in ("mask_lens_mm", "lens_sensor_mm"):
        sentence = sentence.replace(name, f"--{name.replace('_', '-')}")
    return f"{sentence}."


def _bound_covariance(system: System | None) -> NDArray[np.float64] | None:
    """The smallest covariance of a reading of one image; None if the noise is not known."""
    if system is None or system.noise_law is None:
        return None
    from rasnik.performance.bound import bound

    try:
        return bound(system, rounding=True).covariance
    except ValueError:  # a system that shows no fields; its geometry is all the same
        return None


def _given(instrument: ThreePoints, text: str) -> tuple[Reading, int]:
    """The reading of the option, and how many of its numbers were given."""
    from rasnik.geometry.reading import Reading

    values = numbers(text, "--reading", "X,Y,S,THETA", least=2)
    # what is not given is as built, and not used
    rest = (instrument.scale, instrument.theta_rad)[len(values) - 2 :]
    x, y, scale, theta = [*values, *rest]
    return Reading(x, y, scale, theta, instrument.orientation), len(values)


def _invert(
    instrument: ThreePoints,
    given: tuple[Reading, int],
    find: str,
    covariance: NDArray[np.float64] | None,
) -> Displacement:
    from rasnik.geometry.inverse import displacement
    from rasnik.geometry.reading import READINGS

    reading, count = given
    names = [name.strip() for name in find.split(",")]
    if find == _DEFAULT_FIND:
        names = names[:count]
    if covariance is None and count > len(names):
        raise ValueError(
            f"--reading has {count} numbers, --find asks for {len(names)}: their errors have to "
            "weigh them; name a system that states its noise, or give as many of each"
        )
    return displacement(instrument, reading, names, covariance, READINGS[:count])


def _smallest(
    instrument: ThreePoints, covariance: NDArray[np.float64] | None, name: str
) -> float | None:
    """Standard deviation of a motion that alone may have happened, um or rad."""
    import numpy as np

    if covariance is None:
        return None
    column = instrument.matrix([name])[:, 0]
    information = float(column @ np.linalg.solve(covariance, column))
    return 1 / math.sqrt(information) if information > 0 else None


def _print(
    instrument: ThreePoints,
    system: System | None,
    covariance: NDArray[np.float64] | None,
) -> None:
    from rich.table import Table

    from rasnik.geometry.dependence import indistinguishable
    from rasnik.geometry.three_points import ALL_MOTIONS, motion_unit

    console = output()
    name = f"{system.name}: " if system is not None else ""
    console.print(
        f"{name}mask - lens {instrument.mask_lens_mm:g} mm, lens - sensor "
        f"{instrument.lens_sensor_mm:g} mm, S = {instrument.scale:g}, orientation "
        f"{instrument.orientation}; the camera is lens and sensor together, turning "
        + (
            "at the lens"
            if instrument.pivot_mm is None
            else f"{instrument.pivot_mm:g} mm from the mask"
        )
    )
    console.print(
        "Axes: x and y of the mask, z along the light; turns are right-handed about X, Y and X × Y "
        "of the mask. To first order, 1 µm or 1 µrad of:\n"
    )
    table = Table(box=None, pad_edge=False, header_style="bold")
    headings = ["motion", *(f"{one} ({unit})" for one, _, unit in _SHOWN)]
    if covariance is not None:
        headings.append("seen in one image")
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "motion" else "right", no_wrap=True)
    for name in ALL_MOTIONS:
        column = instrument.matrix([name])[:, 0]
        step = 1e-6 if motion_unit(name) == "rad" else 1.0
        sizes = [abs(one) for one in column / instrument.natural_readings]
        cells = [
            f"{one * step * factor:.4g}" if size > 1e-12 * max(sizes) and max(sizes) > 0 else "0"
            for one, size, (_, factor, _) in zip(column, sizes, _SHOWN, strict=True)
        ]
        if covariance is not None:
            cells.append(_motion_text(_smallest(instrument, covariance, name), name))
        table.add_row(name, *cells)
    console.print(table)
    if covariance is not None:
        console.print(
            "\nseen in one image: standard deviation of a motion that alone may have happened, "
            "by the Cramer-Rao bound"
        )
    console.print("\nOne Rasnik cannot tell apart (what is named first counts for the others):")
    for sentence in indistinguishable(instrument):
        console.print(f"  {sentence}")


def _motion_text(value: float | None, name: str) -> str:
    from rasnik.geometry.three_points import motion_unit

    if value is None or not math.isfinite(value):
        return "-"
    if motion_unit(name) == "rad":
        return f"{1e6 * value:.3g} µrad"
    return f"{value:.3g} µm" if value >= 0.1 else f"{1e3 * value:.3g} nm"


def _print_inverse(
    found: Displacement, sagitta: NDArray[np.float64], covariance: NDArray[np.float64]
) -> None:
    from rasnik.geometry.three_points import motion_unit
    from rasnik.report.numbers import with_sigma

    console = output()
    known = math.isfinite(covariance[0, 0])
    fitted = "fitted best by" if found.ndf else "explained exactly by"
    errors = " (errors: the bound for one image)" if known else ""
    console.print(f"\nIf nothing else has moved, the reading is {fitted}{errors}")
    for name in found.names:
        factor, unit = (1e6, "µrad") if motion_unit(name) == "rad" else (1.0, "µm")
        console.print(
            f"  {name:14s} {with_sigma(factor * found[name], factor * found.sigma(name))} {unit}"
        )
    if found.ndf:
        plural = "s" if found.ndf > 1 else ""
        console.print(
            f"  chi-square {found.chi2:.4g} for {found.ndf} degree{plural} of freedom, probability "
            f"{found.probability:.3g}"
        )
    if not _explains(found):
        console.print(
            "These motions do not explain the reading: something else has moved, or the errors are "
            "larger than the bound.",
            style="red",
        )
    x, y = (with_sigma(sagitta[k], math.sqrt(covariance[k, k])) for k in (0, 1))
    console.print(f"Sagitta of the lens on the line from mask to sensor: x {x} µm, y {y} µm")


def _explains(found: Displacement) -> bool:
    """Whether the motions that were asked for may be all there is."""
    from rasnik.geometry.solution import LEAST_PROBABILITY

    return not found.probability < LEAST_PROBABILITY


def _print_air(
    instrument: ThreePoints, air: Air | None, no_air: str, kelvin_per_m: float, assumed: bool
) -> None:
    console = output()
    if air is None:
        console.print(f"\nNothing is said of the air: {no_air}")
        return
    found = _air_document(instrument, air, kelvin_per_m)
    console.print(
        f"\nAir at {air.temperature_k - 273.15:g} °C, {air.pressure_hpa:g} hPa, "
        f"{100 * air.humidity:g} % humidity, {air.wavelength_nm:g} nm"
        f"{' (assumed)' if assumed else ''}: n - 1 = {found['refractivity']:.6g}, "
        f"dn/dT = {found['index_per_k']:.4g} /K"
    )
    same = ", ".join(f"{_shift(um)} of {name}" for name, um in found["equivalent_um"].items())
    console.print(
        f"A gradient of {kelvin_per_m:g} K/m along x all the way adds {_shift(found['shift_um'])} "
        f"to x: as {same} would"
    )
    upward = _shift(found["weight_of_air_upward_um"])
    console.print(f"The weight of the air alone adds {upward} along what points upward")


def _shift(um: float) -> str:
    return f"{um:.3g} µm" if abs(um) >= 0.1 else f"{1e3 * um:.3g} nm"


def _document(
    instrument: ThreePoints,
    system: System | None,
    covariance: NDArray[np.float64] | None,
    air: Air | None,
    no_air: str,
    kelvin_per_m: float,
) -> dict[str, Any]:
    from rasnik.geometry.dependence import dependent
    from rasnik.geometry.reading import READINGS
    from rasnik.geometry.three_points import ALL_MOTIONS, motion_unit

    motions = {}
    for name in ALL_MOTIONS:
        column: Sequence[float] = instrument.matrix([name])[:, 0].tolist()
        unit = motion_unit(name)
        motions[name] = {f"{one}_per_{unit}": v for one, v in zip(READINGS, column, strict=True)}
        motions[name][f"sigma_one_image_{unit}"] = _smallest(  # type: ignore[assignment]
            instrument, covariance, name
        )
    return {
        "system": None if system is None else system.name,
        "mask_lens_mm": instrument.mask_lens_mm,
        "lens_sensor_mm": instrument.lens_sensor_mm,
        "scale": instrument.scale,
        "theta_rad": instrument.theta_rad,
        "orientation": instrument.orientation,
        "x_um": instrument.x_um,
        "y_um": instrument.y_um,
        "motions": motions,
        "reads_as": dependent(instrument),
        "air": {"problem": no_air} if air is None else _air_document(instrument, air, kelvin_per_m),
    }


def _air_document(instrument: ThreePoints, air: Air, kelvin_per_m: float) -> dict[str, Any]:
    from rasnik.geometry.refraction import bending_um, equivalent_motions_um, index_gradient

    gradient = float(index_gradient(air, kelvin_per_m))
    upward = float(index_gradient(air, 0.0, air.hydrostatic_hpa_per_m))
    shift = float(bending_um(instrument, gradient))
    return {
        "temperature_k": air.temperature_k,
        "pressure_hpa": air.pressure_hpa,
        "humidity": air.humidity,
        "wavelength_nm": air.wavelength_nm,
        "refractivity": air.refractivity,
        "index_per_k": air.slopes.per_k,
        "index_per_hpa": air.slopes.per_hpa,
        "kelvin_per_m": kelvin_per_m,
        "index_gradient_per_m": gradient,
        "shift_um": shift,
        "equivalent_um": equivalent_motions_um(instrument, shift),
        "weight_of_air_upward_um": float(bending_um(instrument, upward)),
    }
