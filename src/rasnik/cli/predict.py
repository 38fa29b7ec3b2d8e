"""``rasnik predict``: the resolution an instrument can have."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, load, numbers, output

if TYPE_CHECKING:
    from rasnik.instrument import System
    from rasnik.performance.bound import Bound
    from rasnik.performance.light import Light

__all__ = ["PoseOption", "SetOption", "SystemArgument", "pose_of", "predict_command"]

SystemArgument = Annotated[
    str, typer.Argument(metavar="SYSTEM", help="Shipped system or TOML file.", show_default=False)
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Replace a value, as sensor.binning=2."),
]
PoseOption = Annotated[
    str | None,
    typer.Option(
        "--pose",
        metavar="X,Y[,THETA]",
        help="Where on the mask: um, um, rad. By default where the paper simulates "
        "SolidRas, (4000, 5000) um, or the same fields of another mask.",
    ),
]


#: What was reached with the systems of the paper, with its own analysis (SOAP).
_PAPER = {
    "solidras": "3.0 nm per image of simulated images, 3.3 nm with superpixels (at half light 4.8 "
    "and 5.0); measured with superpixels 180..200 pm/√Hz (sigma/√f)",
    "solidras-uv": "measured with superpixels 110 pm/√Hz (sigma/√f)",
    "microras": "measured 7 pm/√Hz (sigma/√f)",
}


def pose_of(text: str | None) -> tuple[float, ...] | None:
    """The pose of the option ``--pose``."""
    if text is None:
        return None
    return tuple(numbers(text, "--pose", "X,Y,THETA", least=2))


def predict_command(
    system_name: SystemArgument,
    overrides: SetOption = None,
    pose: PoseOption = None,
    average: Annotated[
        int,
        typer.Option(
            "--average",
            metavar="N",
            min=0,
            max=10_000,
            help="Mean over N random positions instead.",
        ),
    ] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="JSON, with more figures.")] = False,
) -> None:
    """Predict the smallest error that any analysis of one image can have (Cramer-Rao).

    Position, scale and rotation are bounded with light, dark, blur and edge shift unknown. All
    is referred to the mask, not to the image.

    [bold]Examples[/]

    rasnik predict solidras

    rasnik predict microras --set sensor.binning=2 --json
    """
    system = load(system_name, overrides or ())
    place = pose_of(pose)
    if place is not None and average:
        fail("--pose and --average exclude each other: one place, or many at random.")

    from rasnik.performance.bound import bound
    from rasnik.performance.light import light_of
    from rasnik.performance.soap import fourier_noise

    try:
        plain = bound(system, place, count=average)
        rounded = bound(system, place, count=average, rounding=True)
        fourier = fourier_noise(system, plain.poses[0])
    except (ValueError, TypeError) as error:
        fail(f"{error}.")
    light = light_of(system)
    if as_json:
        document: dict[str, Any] = {
            "system": system.name,
            "plane": "mask",
            "rounding_counted": False,
            **plain.figures(),
            **{f"rounded_{name}": value for name, value in rounded.figures().items()},
            "fourier_primary_sigma_nm": fourier.primary_nm,
            "fourier_harmonics_sigma_nm": fourier.harmonics_nm,
            "frame_rate_hz": system.sensor.frame_rate_hz,
            "poses": [[p.x_um, p.y_um, p.similarity()[1]] for p in plain.poses],
            **light.figures(),
        }
        typer.echo(json.dumps(document, indent=2))
        return
    _print_bounds(system, plain, rounded)
    output().print(
        f"\nFourier analysis (Hann window), per image: {_si(fourier.primary_nm)} from the primary "
        f"peaks, {_si(fourier.harmonics_nm)} with harmonics"
    )
    if system.name in _PAPER:
        output().print(f"The paper: {_PAPER[system.name]}")
    _print_light(system, light)


def _si(value_nm: float) -> str:
    """A length given in nm, in nm or pm."""
    return f"{value_nm:.3g} nm" if value_nm >= 0.1 else f"{1e3 * value_nm:.3g} pm"


def _print_bounds(system: System, plain: Bound, rounded: Bound) -> None:
    from rich.table import Table

    console = output()
    height, width = system.shape
    console.print(
        f"{system.name}: {width} x {height} pixels of {system.pitch_um:g} µm, fields of "
        f"{system.mask.field_um:g} µm, scale {system.optics.scale:g}, blur "
        f"{system.optics.blur_um:g} µm on the sensor"
    )
    places = len(plain.poses)
    at = plain.poses[0]
    where = f"({at.x_um:.6g}, {at.y_um:.6g}) µm" if places == 1 else f"the mean of {places} places"
    console.print(f"Cramer-Rao bound at {where}, referred to the mask\n")
    table = Table(box=None, pad_edge=False, header_style="bold")
    headings = ("", "per image", "with rounding", "all else known", "sigma/√f", "ASD, one-sided")
    for heading in headings:
        table.add_column(heading, justify="right" if heading else "left")
    bare, full = plain.figures(), rounded.figures()
    for name in ("x", "y"):
        table.add_row(
            name,
            *(_si(one) for one in (bare[f"sigma_{name}_nm"], full[f"sigma_{name}_nm"])),
            _si(bare[f"sigma_{name}_known_nm"]),
            *(_per_root_hz(bare[f"{kind}_{name}_pm_rthz"], "pm") for kind in ("floor", "asd")),
        )
    for label, name, key, unit in (
        ("theta_z", "theta", "theta_rad", "µrad"), ("scale S", "scale", "scale", "1e-6")
    ):  # fmt: skip
        known = bare["sigma_theta_known_rad" if name == "theta" else "sigma_scale_known"]
        sigmas = (bare[f"sigma_{key}"], full[f"sigma_{key}"], known)
        floors = (bare[f"{kind}_{key}_rthz"] for kind in ("floor", "asd"))
        table.add_row(
            label,
            *(f"{1e6 * sigma:.3g} {unit}" for sigma in sigmas),
            *(_per_root_hz(None if f is None else 1e6 * f, unit) for f in floors),
        )
    console.print(table)
    rate = system.sensor.frame_rate_hz
    console.print(
        f"\nsigma/√f as the paper quotes noise floors, ASD = sigma √(2/f), at {rate:g} images/s"
        if rate
        else "\nno noise floor: sensor.frame_rate_hz is not given"
    )
    if system.optics.scale != 1:
        console.print(
            f"In the image plane everything moves {system.optics.scale:g} times as far: x "
            f"{_si(bare['image_sigma_x_nm'])}, y {_si(bare['image_sigma_y_nm'])} per image"
        )


def _per_root_hz(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3g} {unit}/√Hz"


def _print_light(system: System, light: Light) -> None:
    console = output()
    if light.electrons_white is None:
        return
    text = f"\nLight: {light.electrons_white:.3g} electrons in a white pixel (from the shot noise)"
    if light.full_well_use is not None and light.full_well_consistency is not None:
        text += (
            f", {100 * light.full_well_use:.0f} % of the full well; at full scale shot noise and "
            f"full well give numbers in the ratio {light.full_well_consistency:.2f}"
        )
    console.print(text)
    efficiency = light.quantum_efficiency_assumed
    known = system.sensor.quantum_efficiency is not None
    if light.power_uw is not None:
        console.print(
            f"{light.power_uw:.3g} µW on the sensor, half of its pixels white, quantum efficiency "
            f"{efficiency:g}{'' if known else ' assumed, so at least that'}; losses before the "
            "sensor not counted"
        )
