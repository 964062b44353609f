"""One job in one process: calibrate a rig, or measure a recording, from its images to its report.

The numbers of its row are in SI units and have sigmas; unknown numbers are NaN, which is stored as None.
"""

import contextlib
import time
from pathlib import Path

import numpy as np
from filelock import Timeout

from calibration.kit.types import Array
from calibration.rig_file import read_rig
from disctrack.analyse.analysis import Analysis, analyse
from disctrack.analyse.power_laws import PowerLaws
from disctrack.analyse.stage import run_analyse, write_analysis
from disctrack.batch.columns import UNITS, Row, group_of
from disctrack.batch.locks import locked
from disctrack.batch.plan import Job
from disctrack.batch.records import BUSY, MEASURED, SKIPPED, failed, is_done, outcome, read_row, write_row
from disctrack.calibrate.stage import boards_in, calibrate_into, is_rig_of, source_of
from disctrack.diagnosis import DiscSystem, run_diagnose
from disctrack.diagnosis.model_file import declared_model
from disctrack.diagnosis.recorded import wrong_declarations
from disctrack.discrepancy.fit import fit
from disctrack.errors import AnalysisError, DiscTrackError, TrackingError, reason_of
from disctrack.files.json_text import json_sha256, plain
from disctrack.findings import Kind, leading
from disctrack.frames import CAMERAS
from disctrack.recording.declaration import read_recording
from disctrack.track.measurement import measure, open_pairs, trajectory_provenance
from disctrack.trajectory import Trajectory
from disctrack.trajectory.file import Details, kept_or_made

LOCK = ".batch.lock"
BUSY_FOR = 1.0  # [s] to wait for another batch before the job is put back; longer than a cycle of the queue


def do(job: Job) -> Row:
    """Do a job. Never raises an Exception: errors are reported in the row, which is stored with the results."""
    try:
        with locked(job.results / LOCK, BUSY_FOR):
            try:
                return make_rig(job) if job.kind == "rig" else make_recording(job)
            except Exception as error:
                kind = Kind.OTHER
                if isinstance(error, TrackingError):
                    kind = error.findings[0].kind if error.findings else Kind.DISC_NOT_FOUND
                row = failed(reason_of(error), kind)
                with contextlib.suppress(DiscTrackError):  # if this fails, only the running batch reports the error
                    write_row(job.results, row)
                return row
    except Timeout:
        return outcome(BUSY)
    except Exception as error:
        return failed(reason_of(error))


def make_rig(job: Job) -> Row:
    """Calibrate and write job.rig, unless it is already the result of the same inputs."""
    source = source_of(read_recording(job.folder))
    if is_rig_of(job.rig, source) and not job.options.overwrite:
        return outcome(SKIPPED)
    calibrate_into(job.rig, source, overwrite=True, figures=job.options.report)
    return outcome(MEASURED)


def make_recording(job: Job) -> Row:
    """Track, analyse and, if requested, diagnose; existing results of the same inputs are kept."""
    began, used = time.perf_counter(), time.process_time()
    recording = read_recording(job.folder)
    rig, pairs = read_rig(job.rig), open_pairs(recording)
    path, provenance = job.results / "trajectory.h5", trajectory_provenance(recording, rig, pairs, None)

    def measured() -> tuple[Trajectory, Details]:
        found = measure(recording, rig, pairs, threads=job.threads, boards=boards_in(job.rig, recording))
        return found.trajectory, found.details

    trajectory, _, fresh = kept_or_made(path, provenance, measured, job.options.overwrite)
    kept = None if fresh else read_row(job.results)  # is_done checks that it has the trajectory's provenance
    if kept is not None and is_done(job.results, kept, job.options.stages):
        return kept | {"status": SKIPPED}
    row: Row = plain(_after_tracking(path, trajectory, job)) | {
        "name": recording.name,
        "repeats": group_of(recording),
        "rig": str(job.rig),
        "input_sha256": json_sha256(dict(provenance.inputs)),
        "fingerprint": provenance.fingerprint,
        "version": provenance.version,
        "seconds": round(time.perf_counter() - began, 3),
        "processor_seconds": round(time.process_time() - used, 3),
    }
    write_row(job.results, row)
    return row


def _after_tracking(path: Path, trajectory: Trajectory, job: Job) -> Row:
    """Analysis, loss coefficient, diagnosis; if one is not possible, `reason` says why, and the status is MEASURED."""
    row = {"trajectory": path.name, "stages": job.options.stages, **tracked_numbers(trajectory)}
    noticed = leading(trajectory.findings)
    missing = [f.sentence for f in noticed if f.doubtful or f.kind == Kind.UNREADABLE]
    row |= {"severity": noticed[0].grave, "finding": noticed[0].kind.value} if noticed else {}
    try:
        if job.options.report:
            analysed = run_analyse(path, window=job.options.window, overwrite=True)
            analysis, row["report"] = analysed.analysis, analysed.report.relative_to(job.results).as_posix()
        else:
            analysis = analyse(trajectory, job.options.window)
            write_analysis(path, analysis)
        row |= analysed_numbers(analysis)
    except AnalysisError as error:
        missing.append(f"not analysed: {reason_of(error)}")
    row |= friction_numbers(trajectory)
    if job.options.diagnose:
        try:
            if wrong_declarations(trajectory.findings):
                raise AnalysisError("a number is declared wrong, and a missing effect would be read into it")
            diagnosed = run_diagnose(path, overwrite=True).summary
            row |= {
                "diagnosis": diagnosed.data["verdict"],
                "diagnosis_sentence": diagnosed.data["sentence"],
                "diagnosis_p_value": diagnosed.data["chance"].get("p_value"),
                "diagnosis_report": diagnosed.files[0].relative_to(job.results).as_posix(),
            }
        except AnalysisError as error:
            missing.append(f"not diagnosed: {reason_of(error)}")
    return row | outcome(MEASURED, "; ".join(missing))


def tracked_numbers(trajectory: Trajectory) -> Row:
    """Numbers of pairs, misfit in the images and median sigmas."""
    looked_for = trajectory.looked_for
    numbers: Row = {
        "pairs": int(looked_for.sum()),
        "pairs_measured": int(trajectory.measured.sum()),
        "duration_s": np.ptp(trajectory.time[looked_for]),
        "reduced_chi_square": _median(trajectory.reduced_chi_square),
    }
    for camera, rms in zip(CAMERAS, trajectory.reprojection_rms_px.T, strict=True):
        seen = rms[np.isfinite(rms)]
        numbers[f"reprojection_rms_{camera}_px"] = np.sqrt(np.mean(seen**2)) if seen.size else None
    for ending, sigma in (("", trajectory.coordinate_sigma), ("_calibration", trajectory.calibration_sigma)):
        for (name, unit), of_frames in zip(UNITS.items(), sigma.T, strict=True):
            numbers[f"{name}_sigma{ending}_{unit}"] = _median(of_frames)
    return numbers


def analysed_numbers(analysis: Analysis) -> Row:
    """Exponents, instant of collapse and energy; `exponents_undetermined` says why there are none."""
    energy, laws = analysis.energy, analysis.laws if analysis.laws.determined else PowerLaws()
    numbers: Row = {
        "t_f_s": laws.t_f,
        "t_f_sigma_s": laws.t_f_sigma,
        "exponents_undetermined": analysis.laws.reason,
        "energy_loss_J": energy.loss,
        "energy_loss_sigma_J": np.hypot(energy.loss_sigma, energy.loss_sigma_calibration),
    }
    for name in ("n_energy", "n_theta", "n_psidot"):
        numbers |= {name: getattr(laws, name).value, f"{name}_sigma": getattr(laws, name).sigma}
    return numbers


def friction_numbers(trajectory: Trajectory) -> Row:
    """The paper's k_m [m s^2] fitted to the dots of all frames, with the reduced chi-square of that model.

    If that is far from 1, an effect is missing in the model and k_m is biased by it: sigma is then multiplied by the
    root of chi-square, which is only indicative. `k_m_undetermined` says why there is no k_m.
    """
    try:
        model, faults = declared_model(trajectory)
        system = DiscSystem(trajectory, model, candidates=(), known=faults)
        found = fit(system, system.base, system.start())
    except AnalysisError as error:
        return {"k_m_undetermined": str(error)}
    if not found.converged:
        return {"k_m_undetermined": "the rolling model with this loss does not fit the motion"}
    return {
        "k_m_m_s2": found.values["km.k_m"],
        "k_m_sigma_m_s2": found.sigma("km.k_m") * np.sqrt(max(found.reduced_chi_square, 1.0)),
        "k_m_reduced_chi_square": found.reduced_chi_square,
        "k_m_undetermined": "",
    }


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None
