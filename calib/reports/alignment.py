"""Report of an alignment."""

from calib.alignment import Comparison, RestAlignment
from calib.reports.document import Document, KeyValues, Section, Table, sanitise
from imudrv.units import DEG, DEG_PER_H


def document(result: RestAlignment) -> Document:
    """Return the report of an alignment."""
    aligned = result.aligned
    attitude = [
        (axis, f"{azimuth:+.4f}", f"{elevation:+.4f}")
        for axis, azimuth, elevation in zip("XYZ", result.azimuth_deg, result.elevation_deg, strict=True)
        if axis != result.up[1]
    ]
    sigma = f"{aligned.heading_sigma_rad / DEG:.4f}", f"{aligned.level_sigma_rad / DEG:.4f}"
    *rates, force = result.comparisons
    return Document(
        "Alignment",
        f"{sanitise(result.name)}, {result.begin_s:.1f} to {result.end_s:.1f} s, {result.up} up",
        (
            Section("Verdict", (KeyValues(result.verdicts),)),
            Section(
                "Attitude at the end",
                (
                    Table(
                        "Level axes of the body, deg",
                        ("", "from north to east", "above horizon"),
                        (*attitude, ("sigma", *sigma)),
                    ),
                ),
            ),
            Section(
                "Readings and site",
                (
                    Table(
                        "Means at rest",
                        ("", "measured", "site", "difference", "sigma"),
                        (
                            *(
                                _row(f"{rate.name.removeprefix('the ')}, deg/h", rate, DEG_PER_H, 4)
                                for rate in rates
                            ),
                            _row("specific force, m/s^2", force, 1.0, 5),
                        ),
                    ),
                ),
            ),
        ),
    )


def _row(name: str, compared: Comparison, unit: float, decimals: int) -> tuple[str, ...]:
    measured, of_site, sigma = (x / unit for x in (compared.measured, compared.of_site, compared.sigma))
    return (
        name,
        f"{measured:.{decimals}f}",
        f"{of_site:.{decimals}f}",
        f"{measured - of_site:+.{decimals}f}",
        f"{sigma:.{decimals}f}",
    )
