"""Interactive page of the motion: one HTML file that needs neither server nor network.

Disc in 3-D with the path of its contact, camera images with the fit, nutation, precession rate and energy with a common
cursor, and the residuals of the frame at the cursor. `report/motion.js` draws it.
"""

import base64
import json
from collections.abc import Callable, Iterator
from importlib.resources import files
from typing import Any

import cv2
import numpy as np

from calibration.kit.types import AnyArray, Array, Indices, evenly
from disctrack.analyse.analysis import Analysis
from disctrack.files.json_text import plain
from disctrack.findings import carried
from disctrack.report.blocks import Markup, Report
from disctrack.report.html import page
from disctrack.report.palette import RED
from disctrack.trajectory import FrameStatus, Trajectory

Drawn = Callable[[int], AnyArray]  # frame -> both images with the fit on them, (height, 2 width, 3) BGR

MOST_ROWS = 1500  # frames on the page: every second, third, ... of longer recordings
MOST_PICTURES = 80


def motion_html(analysis: Analysis, name: str, drawn: Drawn | None = None) -> str:
    """The whole page. drawn : returns the picture of a frame, if the images are available"""
    content = page_data(analysis, drawn)
    data = json.dumps(content, separators=(",", ":")).replace("</", "<\\/")
    script = files("disctrack.report").joinpath("motion.js").read_text(encoding="utf-8")
    curves = "".join(
        f'<canvas id="curve-{k}" class="curve" role="img" aria-label="{series["name"]} over time"></canvas>'
        for k, series in enumerate(content["series"])
    )
    picture = (
        '<figure><img id="picture" alt="left and right camera"><figcaption id="picture-caption"></figcaption></figure>'
        if content["pictures"]
        else "<p>The images were not at hand when this page was made.</p>"
    )
    body = Markup(
        '<div class="bar"><button id="play" type="button">▶ play</button>'
        '<label>slower by <select id="speed"><option>1</option><option selected>10</option><option>100</option>'
        '</select></label><input id="slider" type="range" min="0" value="0" aria-label="time">'
        '<button id="whole" type="button">whole time</button></div><p id="told" role="status"></p>'
        '<div class="two"><section><h2>Disc and path of its contact</h2><canvas id="space" role="img" '
        'aria-label="disc in three dimensions"></canvas><p class="hint">Drag to turn, wheel to zoom.</p></section>'
        f"<section><h2>Cameras</h2>{picture}<h2>Residuals of this frame</h2>"
        '<canvas id="residuals" role="img" aria-label="residuals of the dots"></canvas></section></div>'
        f'<section><h2>Curves (band: ± 3 σ by noise)</h2>{curves}<p class="hint">Click to go to a time, drag over a '
        "part to zoom, double click for the whole.</p></section>"
        f'<script type="application/json" id="motion-data">{data}</script><script>{script}</script>'
    )
    trajectory = analysis.trajectory
    every = f"; every {_stride(trajectory)}th frame is shown" * (_stride(trajectory) > 1)
    said = f"{', '.join(map(' '.join, trajectory.facts().items()))}{every}"
    report = Report(f"{name}: the motion", "", said, carried(trajectory.findings), blocks=[body])
    return page(report, head=f"<style>{_STYLE}</style>")


def page_data(analysis: Analysis, drawn: Drawn | None = None) -> dict[str, Any]:
    """Data of the page in types of JSON; lengths in mm, angles in degrees, None if unknown."""
    trajectory = analysis.trajectory
    rows = np.arange(0, len(trajectory), _stride(trajectory))
    energy, psidot = analysis.series("total"), analysis.series("psidot")
    contact = [1e3 * analysis.series(f"contact_{axis}").value[rows] for axis in "xy"]
    q, disc = trajectory.q[rows], trajectory.disc
    theta_sigma = np.degrees(trajectory.coordinate_sigma[rows, 4])
    residual = trajectory.markers_residual_px[rows]
    finite = np.abs(residual[np.isfinite(residual)])
    middle = np.nanmean(1e3 * q[:, :2], axis=0) if trajectory.measured[rows].any() else np.zeros(2)

    def series(name: str, unit: str, digits: int, value: Array, sigma: Array) -> dict[str, Any]:
        return {"name": name, "unit": unit, "digits": digits, "value": _plain(value, 6), "sigma": _plain(sigma, 7)}

    return {
        "time": _plain(trajectory.time[rows], 7),
        "frame": trajectory.frame[rows].tolist(),
        "status": [FrameStatus(int(status)).sentence for status in trajectory.frame_status[rows]],
        "words": [_in_words(row) for row in q],
        "xyz": _plain(1e3 * q[:, :3], 4),
        "quaternion": _plain(trajectory.quaternion[rows], 6),
        "contact": _plain(np.column_stack(contact), 4),
        "middle": _plain(middle, 3),
        "disc": {
            "radius_mm": 1e3 * disc.radius,
            "thickness_mm": 2e3 * disc.half_thickness,
            "dot_mm": 1e3 * disc.marker_diameter,
            "dots_mm": _plain(1e3 * disc.marker_centres_body[:, :2], 4),
        },
        "series": [
            series("nutation θ", "deg", 4, np.degrees(q[:, 4]), theta_sigma),
            series("precession rate", "rad/s", 3, psidot.value[rows], psidot.sigma[rows]),
            series("energy", "mJ", 4, 1e3 * energy.value[rows], 1e3 * energy.sigma[rows]),
        ],
        "residual_px": _plain(residual, 5),
        "residual_reach_px": float(1.2 * np.percentile(finite, 99.5)) if finite.size else 1.0,
        "rms_px": _plain(trajectory.reprojection_rms_px[rows], 5),
        "pictures": [] if drawn is None else list(_pictures(rows, drawn)),
    }


def _stride(trajectory: Trajectory) -> int:
    return max(1, -(-len(trajectory) // MOST_ROWS))


def _in_words(q: Array) -> str:
    if not np.isfinite(q).all():
        return ""
    (x, y, z), (psi, theta, phi) = 1e3 * q[:3], np.degrees(q[3:])
    return f"x {x:.3f}  y {y:.3f}  z {z:.3f} mm   ψ {psi:.2f}  θ {theta:.3f}  φ {phi:.2f}°"


def _plain(values: Array, digits: int) -> object:
    """Nested lists, rounded; None for NaN."""
    return plain(np.round(np.asarray(values, float), digits))


def _pictures(rows: Indices, drawn: Drawn) -> Iterator[dict[str, Any]]:
    for k in evenly(len(rows), MOST_PICTURES):
        picture = drawn(int(rows[k]))
        scale = min(1.0, 300 / picture.shape[0])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        coded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 72])[1]
        yield {"row": k, "uri": f"data:image/jpeg;base64,{base64.b64encode(coded.tobytes()).decode()}"}


_STYLE = f"""
:root{{--second:{RED}}}@media (prefers-color-scheme:dark){{:root{{--second:#ff9a5c}}}}
.bar{{display:flex;gap:.8rem;align-items:center;flex-wrap:wrap;position:sticky;top:0;background:var(--back);
padding:.6rem 0;z-index:1}}.bar input{{flex:1 1 12rem}}
button,select{{font:inherit;color:var(--ink);background:var(--card);border:1px solid var(--line);border-radius:6px;
padding:.3rem .8rem}}button{{min-width:6.5rem}}
#told{{font-variant-numeric:tabular-nums;white-space:pre-wrap;margin:.2rem 0;min-height:1.6em}}
.two{{display:grid;grid-template-columns:minmax(0,1fr) minmax(0,1fr);gap:1.2rem}}.two section{{margin:.6rem 0}}
canvas{{display:block;width:100%}}#space{{height:29rem;touch-action:none;cursor:grab}}#residuals{{height:15rem}}
.curve{{height:9rem;touch-action:pan-y;cursor:crosshair}}.curve:last-of-type{{height:10.5rem}}
.hint{{color:var(--soft);font-size:.85rem;margin:.4rem 0 0}}
@media (max-width:56rem){{.two{{grid-template-columns:minmax(0,1fr);gap:0}}#space{{height:19rem}}}}
@media print{{.bar,.hint{{display:none}}section{{break-inside:avoid}}canvas{{object-fit:contain}}
.two{{grid-template-columns:minmax(0,1fr) minmax(0,1fr);gap:1.2rem}}#space{{height:16rem}}}}
"""
