"""From where each landmark is seen best: the standard views of the page of landmarks."""

# Degrees as in camera.js (azimuth 0 from the front, 90 from the patient's left; elevation 90 from
# above), and the height of the picture, mm. Of pairs, the view of the left one.
MIDLINE = (35.0, 5.0, 110.0)
VIEWS: dict[str, tuple[float, float, float]] = {
    "menton": (20.0, -35.0, 110.0),
    "subnasale": (35.0, -15.0, 90.0),
    "labiale_superius": (25.0, 0.0, 90.0),
    "labiale_inferius": (25.0, 0.0, 90.0),
    "frontal_eminence": (25.0, 10.0, 150.0),
    "supraorbital": (15.0, -5.0, 110.0),
    "suborbital": (15.0, 15.0, 110.0),
    "inferior_malar": (30.0, -15.0, 110.0),
    "lateral_orbit": (60.0, 5.0, 110.0),
    "zygomatic_arch": (65.0, -15.0, 120.0),
    "supraglenoid": (80.0, -10.0, 120.0),
    "gonion": (75.0, -10.0, 130.0),
    "supra_m2": (55.0, -5.0, 110.0),
    "occlusal_line": (60.0, 0.0, 120.0),
    "sub_m2": (60.0, -5.0, 110.0),
    "exocanthion": (25.0, 0.0, 90.0),
    "endocanthion": (15.0, 0.0, 90.0),
    "alare": (25.0, -10.0, 90.0),
    "cheilion": (25.0, 0.0, 90.0),
}


def site_view(name: str) -> dict[str, float]:
    """The azimuth, elevation (degrees) and height (mm) of the picture that shows a site."""
    side = name[-2:] if name.endswith(("_L", "_R")) else ""
    azimuth, elevation, span = VIEWS.get(name.removesuffix(side), MIDLINE)
    return {
        "azimuth": -azimuth if side == "_R" else azimuth,
        "elevation": elevation,
        "span": span,
    }
