"""Rigs from and to formats of other programs.

All use x_camera = R x_reference + t, and pixel (0, 0) is the centre of the top-left pixel, as here, unless their
section says otherwise. None stores the covariance: a rig that is read has none, and the sigmas of poses measured with
it are without the uncertainty of the calibration.
"""

import ast
import io
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy

from calibration.cameras.camera import Camera, StereoRig, normalise, placed, project_with_jacobians
from calibration.kit.types import Array
from disctrack.errors import OutputError, RigFileError, told_as
from disctrack.files.toml_tree import MOST, toml_value
from disctrack.files.whole import read_regular, whole_file, write_whole
from disctrack.frames import rotation_from_vector, vector_from_rotation

Table = Mapping[str, Any]
BROWN = ("k1", "k2", "p1", "p2", "k3")
MAX_BYTES = 50_000_000  # of a file; mrcal stores the whole calibration in the file of a camera


def camera_of(K: Array, D: Array, size: Array, where: str) -> Camera:
    """Camera from a camera matrix, up to 14 distortion coefficients in OpenCV's order, and image size (width, height).

    Raises RigFileError, whose message begins with `where`.
    """
    if K.shape != (3, 3) or not np.isfinite(K).all() or not (K[0, 0] > 0 and K[1, 1] > 0):
        raise RigFileError(f"{where}: {K.tolist()} is not a camera matrix")
    if not np.abs(K - [[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]]).max() < 1e-9:
        said = f"the camera matrix is {K.tolist()}; expected fx, 0, cx; 0, fy, cy; 0, 0, 1: without skew"
        raise RigFileError(f"{where}: {said} (MATLAB keeps it transposed, and R, too)")
    if not (size >= 1).all() or not (size < MOST).all():
        raise RigFileError(f"{where}: no image size")
    if len(D) > 14 or not np.isfinite(D).all() or np.any(D[5:] != 0):
        raise RigFileError(f"{where}: the lens terms are {D.tolist()}; k1 k2 p1 p2 k3 can be read, and no further")
    terms = np.append(D, np.zeros(5))[:5]
    return Camera.from_parameters(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *terms]), (int(size[0]), int(size[1])))


def array_of(table: Table, key: str, shape: tuple[int, ...], where: str) -> Array:
    """The finite numbers of a key, in this shape. Raises RigFileError."""
    said = f"{where}: '{key}' is missing, or not numbers of shape {shape}"
    with told_as(RigFileError, said, KeyError, TypeError, ValueError):
        value = np.asarray(table[key], float).reshape(shape)
    if not np.isfinite(value).all():
        raise RigFileError(f"{where}: '{key}' holds numbers that are not finite")
    return value


def rotation_of(rotation: Array, where: str) -> Array:
    """(3, 3) from a matrix or a rotation vector. Raises RigFileError, whose message begins with `where`."""
    with np.errstate(all="ignore"):  # numbers in a file could overflow; they give no rotation
        R = rotation_from_vector(rotation.reshape(3)) if rotation.size == 3 else rotation
    whole = R.size == 9 and np.abs(R).max() < 2  # larger numbers in a file could overflow
    R = R.reshape(3, 3) if whole else np.zeros((3, 3))
    if not np.abs(R @ R.T - np.eye(3)).max() < 1e-6 or np.linalg.det(R) < 0:
        raise RigFileError(f"{where}: {rotation.tolist()} is not a rotation")
    return R


def content_of(path: Path) -> str:
    """The file's text. Raises RigFileError."""
    with told_as(RigFileError, f"{path}: cannot be read", OSError, UnicodeDecodeError):
        return read_regular(path, MAX_BYTES).decode()


def the_one(paths: Sequence[Path]) -> Path:
    """The only path, for formats with a single file. Raises RigFileError."""
    if len(paths) != 1:
        raise RigFileError(f"{len(paths)} files given ({', '.join(map(str, paths))}); one is converted at a time")
    return paths[0]


# --- Caliscope's camera_array.toml, Pose2Sim's Calib.toml, Anipose's calibration.toml (read only) ---------------------
# Per camera: size, matrix, distortions in OpenCV's order; rotation (a vector), translation from the reference.
# Caliscope numbers cameras in [cameras]; Pose2Sim and Anipose name them at the top level, Pose2Sim without k3.


def write_caliscope(path: Path, rig: StereoRig) -> None:
    """Write cameras 0 (left) and 1 (right), lengths in metres. Raises OutputError."""
    _write_toml(path, rig, {f"cameras.{number}": {"cam_id": number, "rotation_count": 0} for number in (0, 1)}, 5)


def write_pose2sim(path: Path, rig: StereoRig) -> None:
    """Write cameras cam_01 (left) and cam_02 (right), lengths in metres, without k3. Raises OutputError."""
    end = "[metadata]\nadjusted = false\nerror = 0.0\n"
    _write_toml(path, rig, {name: {"name": name} for name in ("cam_01", "cam_02")}, 4, end)


def _write_toml(path: Path, rig: StereoRig, tables: Mapping[str, Table], terms: int, end: str = "") -> None:
    text = ""
    for (name, own), camera, (R, t) in zip(tables.items(), rig.cameras, rig.camera_poses(), strict=True):
        table = {"size": camera.image_size, "matrix": camera.camera_matrix, "distortions": camera.distortion[:terms]}
        table |= {"translation": t, "rotation": vector_from_rotation(R), "fisheye": False}
        text += f"[{name}]\n{_lines('{} = {}', {**own, **table})}\n"
    write_whole(path, (text + end).encode())


def _lines(form: str, table: Mapping[str, object]) -> str:
    return "".join(f"{form.format(key, toml_value(value))}\n" for key, value in table.items())


def read_caliscope(path: Path, *, cameras: tuple[str, str] | None = None, world_is_table: bool = False) -> StereoRig:
    """Two cameras of such a file.

    cameras : their names ("0", "1"; "cam_0", ...) if the file has more than two; left first
    world_is_table : True if the file's reference is the table, k up; otherwise heights are meaningless
    Raises RigFileError that lists the cameras of the file.
    """
    with told_as(RigFileError, f"{path}: not TOML", ValueError):
        content = tomllib.loads(content_of(path))
    tables = content.get("cameras", content)
    found = {name: table for name, table in tables.items() if isinstance(table, dict) and "matrix" in table}
    names = cameras or tuple(found)
    if len(names) != 2 or not all(name in found for name in names):
        raise RigFileError(f"{path}: holds the cameras {', '.join(found) or 'none'}; name two of them, left first")
    parts = []
    for name in names:
        table, where = found[name], f"{path}, camera {name}"
        if table.get("fisheye"):
            raise RigFileError(f"{where}: a fisheye lens; only Brown's distortion can be read")
        K, size = array_of(table, "matrix", (3, 3), where), array_of(table, "size", (2,), where)
        D = array_of(table, "distortions", (-1,), where) if "distortions" in table else np.zeros(0)
        if not table.get("rotation"):
            raise RigFileError(f"{where}: has no rotation: its place was not calibrated")
        R = rotation_of(array_of(table, "rotation", (-1,), where), where)
        parts.append((camera_of(K, D, size, where), R, array_of(table, "translation", (3,), where)))
    return StereoRig(**placed(parts), world_is_table=world_is_table)


# --- Kalibr's camchain YAML: cam0 (left), cam1 (right), pinholes with radtan or no distortion -------------------------
# cam1 has T_cn_cnm1 (4, 4), from cam0's axes to its own, in metres. Kalibr has no world frame.


def write_kalibr(path: Path, rig: StereoRig) -> None:
    """Write the rig without k3 and world frame. Raises OutputError."""
    text = ""
    for number, camera in enumerate(rig.cameras):
        table: dict[str, object] = {
            "cam_overlaps": [1 - number],
            "camera_model": "pinhole",
            "distortion_model": "radtan",
        }
        table |= {"distortion_coeffs": camera.distortion[:4], "intrinsics": camera.parameters[:4]}
        table |= {"resolution": camera.image_size, "rostopic": f"/cam{number}/image_raw"}
        text += f"cam{number}:\n{_lines('  {}: {}', table)}"
    T = np.vstack([np.column_stack([rig.R_right_left, rig.t_right_left]), np.eye(4)[3]])
    write_whole(path, (text + _lines("  {}: {}", {"T_cn_cnm1": T})).encode())


def read_kalibr(path: Path) -> StereoRig:
    """A rig from cam0 and cam1 of a camchain. Raises RigFileError; OutputError if PyYAML is not installed."""
    remedy = "Install it: pip install pyyaml"
    with told_as(OutputError, f"{path}: Kalibr's YAML needs PyYAML", ImportError, then=remedy):
        import yaml
    with told_as(RigFileError, f"{path}: not YAML", Exception):
        chain = yaml.safe_load(content_of(path))
    parts = []
    for name in ("cam0", "cam1"):
        where, table = f"{path}, {name}", chain.get(name) if isinstance(chain, dict) else None
        if not isinstance(table, dict):
            raise RigFileError(f"{path}: holds no {name}; a camchain of two cameras has cam0 and cam1")
        lens, model = table.get("distortion_model"), table.get("camera_model")
        if model != "pinhole" or lens not in ("radtan", "none"):
            raise RigFileError(f"{where}: {model} with {lens}; pinhole with radtan (Brown's k1 k2 p1 p2) can be read")
        K, size = _matrix(*array_of(table, "intrinsics", (4,), where)), array_of(table, "resolution", (2,), where)
        D = array_of(table, "distortion_coeffs", (-1,), where) if lens == "radtan" else np.zeros(0)
        T = np.eye(4) if name == "cam0" else array_of(table, "T_cn_cnm1", (4, 4), where)
        parts.append((camera_of(K, D, size, where), rotation_of(T[:3, :3], where), T[:3, 3]))
    return StereoRig(**placed(parts))


# --- mrcal's .cameramodel, one file per camera, with Brown's lens model -----------------------------------------------

_TERMS = {"LENSMODEL_PINHOLE": 0, "LENSMODEL_OPENCV4": 4, "LENSMODEL_OPENCV5": 5}


def sides_of(path: Path) -> tuple[Path, Path]:
    """The two files of mrcal's rig: NAME-left and NAME-right."""
    return path.with_name(f"{path.stem}-left{path.suffix}"), path.with_name(f"{path.stem}-right{path.suffix}")


def write_mrcal(path: Path, rig: StereoRig) -> None:
    """Write `sides_of` the path; the reference is the rig's world, lengths in metres. Raises OutputError."""
    for side, camera, (R, t) in zip(sides_of(path), rig.cameras, rig.camera_poses(), strict=True):
        text = (
            "{\n"
            "    'lensmodel':  'LENSMODEL_OPENCV5',\n"
            "    # fx, fy, cx, cy, k1, k2, p1, p2, k3\n"
            f"    'intrinsics': {toml_value(camera.parameters)},\n"
            "    # rotation vector and translation [m]: reference to camera\n"
            f"    'extrinsics': {toml_value(np.concatenate([vector_from_rotation(R), t]))},\n"
            f"    'imagersize': {toml_value(camera.image_size)}\n"
            "}\n"
        )
        write_whole(side, text.encode())


def read_mrcal(paths: Sequence[Path], *, world_is_table: bool = False) -> StereoRig:
    """A rig from two .cameramodel files with one reference, left first. Raises RigFileError, also for other lenses.

    world_is_table : True if their reference is the table, k up
    """
    if len(paths) != 2:
        raise RigFileError(f"{paths[0]}: mrcal keeps one camera per file; give two, left first")
    parts = []
    for path in paths:
        with told_as(RigFileError, f"{path}: not a .cameramodel of mrcal", Exception):
            model = ast.literal_eval(content_of(path).strip())
        if not isinstance(model, dict):
            raise RigFileError(f"{path}: not a .cameramodel of mrcal: no dictionary")
        name = str(model.get("lensmodel", model.get("lens_model", "none")))
        if name not in _TERMS:
            known = ", ".join(_TERMS)
            raise RigFileError(f"{path}: lens model {name}; {known} can be read. mrcal-convert-lensmodel fits one")
        numbers, size = (
            array_of(model, key, (n,), str(path)) for key, n in (("intrinsics", 4 + _TERMS[name]), ("imagersize", 2))
        )
        rt = array_of(model, "extrinsics" if "extrinsics" in model else "rt_cam_ref", (6,), str(path))
        camera = camera_of(_matrix(*numbers[:4]), numbers[4:], size, str(path))
        parts.append((camera, rotation_of(rt[:3], str(path)), rt[3:]))
    return StereoRig(**placed(parts), world_is_table=world_is_table)


# --- Direct linear transformation: the dltcoefs.csv of DLTdv8 and easyWand, a column of 11 numbers per camera ---------
#     u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1),  v = (L5 X + L6 Y + L7 Z + L8) / (the same)
# X, Y, Z are in metres. It describes a camera without distortion; pixels count from 1 at the top left.

_FROM_ONE = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])  # pixels from 0 -> pixels from 1


def write_dlt(path: Path, rig: StereoRig) -> None:
    """Write the coefficients of both cameras (11 rows, left and right). Raises OutputError."""
    columns = []
    for camera, (R, t) in zip(rig.cameras, rig.camera_poses(), strict=True):
        P = _FROM_ONE @ camera.camera_matrix @ np.column_stack([R, t])
        columns.append((P / P[2, 3]).ravel()[:11])
    write_whole(path, "".join(f"{left:.17g},{right:.17g}\n" for left, right in zip(*columns, strict=True)).encode())


def read_dlt(
    path: Path, *, image_size: tuple[int, int] | None = None, unit: float = 1.0, world_is_table: bool = False
) -> StereoRig:
    """Two cameras without distortion from their coefficients; image_size (width, height) [px] is not in the file.

    unit : [m] length of the coefficients' unit
    world_is_table : True if their axes are the table's, z up
    Raises RigFileError, also for a skewed camera, which eleven free coefficients may describe.
    """
    with told_as(RigFileError, f"{path}: not a table of DLT coefficients", ValueError):
        L = np.array([[float(cell) for cell in line.split(",")] for line in content_of(path).split()])
    if L.shape != (11, 2) or not np.isfinite(L).all():
        raise RigFileError(f"{path}: {L.shape} numbers; coefficients of two cameras are 11 rows of 2 finite ones")
    if image_size is None:
        raise RigFileError(f"{path}: does not tell the image size; give width and height")
    parts = []
    for number, column in enumerate(L.T, start=1):
        P = np.linalg.inv(_FROM_ONE) @ np.append(column, 1.0).reshape(3, 4)
        P *= np.sign(np.linalg.det(P[:, :3]))  # its sign is arbitrary
        K, R, (*centre, scale) = cv2.decomposeProjectionMatrix(P)[:3]
        t = -R @ np.ravel(centre) / scale * unit
        parts.append((camera_of(K / K[2, 2], np.zeros(0), np.array(image_size), f"{path}, camera {number}"), R, t))
    return StereoRig(**placed(parts), world_is_table=world_is_table)


def _matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


# --- OpenCV's YAML, XML or JSON: the arguments of its functions under the names of its stereo sample, M1 D1 M2 D2 R T -

_YAML = ("M1", "D1", "M2", "D2", "R", "T")


def write_opencv(path: Path, rig: StereoRig) -> None:
    """Write intrinsics and extrinsics; lengths in metres. Raises OutputError.

    M1 D1 M2 D2 R T are arguments of cv2.stereoRectify; R_left_world and t_left_world define the world frame.
    """
    with whole_file(path, suffix=path.suffix) as part:
        storage = cv2.FileStorage(str(part), cv2.FILE_STORAGE_WRITE)
        if not storage.isOpened():
            raise OutputError(f"{path}: the rig cannot be written there")
        storage.write("unit", "m")
        sizes = {f"image_size{c}": np.array([camera.image_size], np.int32) for c, camera in enumerate(rig.cameras, 1)}
        for name, number in (_numbers(rig, _YAML) | sizes).items():
            storage.write(name, number)
        storage.release()


def read_opencv(
    paths: Sequence[Path],
    *,
    image_size: tuple[int, int] | None = None,
    unit: float | None = None,
    world_is_table: bool = False,
) -> StereoRig:
    """A rig from one file, or from two (intrinsics.yml and extrinsics.yml of OpenCV's sample).

    image_size : (width, height) [px], needed if the files do not contain it
    unit : [m] length of the file's unit (0.025 if T is in squares of 25 mm); default: metres if the file says so
    world_is_table : True if R_left_world and t_left_world are those of the table, k up, whatever the file says

    The covariance is zero, as such files contain none. Raises RigFileError.
    """
    nodes: dict[str, Any] = {"unit": "", "world_is_table": False}
    for path in paths:
        nodes |= _nodes(path)
    where = ", ".join(str(p) for p in paths)
    if missing := [name for name in _YAML if name not in nodes]:
        raise RigFileError(f"{where}: {', '.join(missing)} missing; a stereo rig has M1, D1, M2, D2, R and T")
    if unit is None and nodes["unit"] != "m":
        raise RigFileError(f"{where}: does not say in which unit T is; give it (0.025 for squares of 25 mm)")
    sizes = [nodes.get(f"image_size{number}", np.array(image_size or (), float)).ravel() for number in (1, 2)]
    if any(size.size != 2 for size in sizes):
        raise RigFileError(f"{where}: does not tell the image size; give width and height")
    if not {"R_left_world", "t_left_world"} <= nodes.keys():
        if world_is_table:
            raise RigFileError(f"{where}: without R_left_world and t_left_world nothing says where the table is")
        nodes = {name: nodes[name] for name in _YAML}
    return _stereo_rig(nodes, _YAML, sizes, 1.0 if unit is None else unit, world_is_table, where)


def _nodes(path: Path) -> dict[str, Any]:
    """Entries of a file that belong to a rig. Raises RigFileError."""
    found: dict[str, Any] = {}
    with told_as(RigFileError, f"{path}: not a stereo rig in OpenCV's YAML, XML or JSON format", Exception):
        storage = cv2.FileStorage(content_of(path), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        for name in (*_YAML, "image_size1", "image_size2", "R_left_world", "t_left_world"):
            matrix = storage.getNode(name).mat()
            if matrix is not None:
                found[name] = np.asarray(matrix, float)
        if storage.getNode("unit").string() == "m":
            found["unit"] = "m"
        if storage.getNode("world_is_table").real() == 1.0:
            found["world_is_table"] = True
    return found


# --- MAT files of version 5, for MATLAB and Octave: the arguments of MATLAB's function, as they can hold no object ----
#     s = load('rig.mat');
#     stereoParams = stereoParametersFromOpenCV(s.intrinsicMatrix1, s.distortionCoefficients1, s.intrinsicMatrix2, ...
#         s.distortionCoefficients2, s.rotationOfCamera2, s.translationOfCamera2, s.imageSize, WorldUnits=s.worldUnits);
# For the reverse, save the values of stereoParametersToOpenCV under these names. MATLAB's image size: (rows, columns).

_MAT = [f"{what}{number}" for number in (1, 2) for what in ("intrinsicMatrix", "distortionCoefficients")]
_MAT += ["rotationOfCamera2", "translationOfCamera2"]


def write_stereo_parameters(path: Path, rig: StereoRig) -> None:
    """Write arguments of stereoParametersFromOpenCV in metres, and the world frame. Raises OutputError."""
    size = np.array(rig.left.image_size[::-1], float)[None]
    save_mat(path, {"worldUnits": "m", "imageSize": size} | _numbers(rig, _MAT))


def read_stereo_parameters(path: Path, *, unit: float | None = None, world_is_table: bool = False) -> StereoRig:
    """A rig from a MAT file with these arguments.

    unit : [m] of translationOfCamera2 if the file has no worldUnits
    world_is_table : True if the world of R_left_world is the table, k up, whatever the file says
    Raises RigFileError.
    """
    with told_as(RigFileError, f"{path}: not a MAT file of version 5", Exception, then="Save it with -v6 or -v7."):
        found = scipy.io.loadmat(path)
    if "intrinsicMatrix1" not in found:
        names = ", ".join(name for name in found if not name.startswith("__"))
        raise RigFileError(f"{path}: holds {names or 'nothing'}; save by name what stereoParametersToOpenCV returns")
    stated = str(np.ravel(found.get("worldUnits", ""))[0]) if np.size(found.get("worldUnits", "")) else ""
    scale = unit if unit is not None else {"m": 1.0, "mm": 1e-3}.get(stated)
    if scale is None:
        raise RigFileError(f"{path}: does not say in which unit translationOfCamera2 is; give it (0.001 for mm)")
    size = array_of(found, "imageSize", (2,), str(path))[::-1]
    return _stereo_rig(found, _MAT, (size, size), scale, world_is_table, str(path))


def save_mat(path: Path, content: Mapping[str, Any]) -> None:
    """Write variables by their names. Raises OutputError."""
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, dict(content), oned_as="column", long_field_names=True)
    write_whole(path, buffer.getbuffer())


def _stereo_rig(
    found: Mapping[str, Any],
    names: Sequence[str],
    sizes: Sequence[Array],
    unit: float,
    world_is_table: bool,
    where: str,
) -> StereoRig:
    """A rig from arguments of OpenCV's functions; names : of K and D of both cameras, of R and t from left to right.

    Also uses R_left_world, t_left_world and world_is_table if found. unit : [m]
    Raises RigFileError.
    """
    *of_cameras, R, t = names
    cameras = [
        camera_of(array_of(found, K, (3, 3), where), array_of(found, D, (-1,), where), size, f"{where}: {K}, {D}")
        for K, D, size in zip(of_cameras[::2], of_cameras[1::2], sizes, strict=True)
    ]
    world = {"R_left_world": np.eye(3), "t_left_world": np.zeros(3), "world_is_table": 0.0, **found}
    places: dict[str, Any] = {}
    for rotation, translation, between in ((R, t, "right_left"), ("R_left_world", "t_left_world", "left_world")):
        places[f"R_{between}"] = rotation_of(array_of(world, rotation, (-1,), where), f"{where}: {rotation}")
        places[f"t_{between}"] = unit * array_of(world, translation, (3,), where)
    is_table = world_is_table or bool(np.ravel(world["world_is_table"])[0])
    return StereoRig(cameras[0], cameras[1], **places, world_is_table=is_table)


def _numbers(rig: StereoRig, names: Sequence[str]) -> dict[str, Any]:
    """The inverse of `_stereo_rig`, in metres: values of `names`, and the world frame."""
    of_cameras = [number for camera in rig.cameras for number in (camera.camera_matrix, np.array([camera.distortion]))]
    numbers = dict(zip(names, (*of_cameras, rig.R_right_left, rig.t_right_left[:, None]), strict=True))
    world = {"R_left_world": rig.R_left_world, "t_left_world": rig.t_left_world[:, None]}
    return numbers | world | {"world_is_table": int(rig.world_is_table)}


# --- Approximation of a lens field, or of coefficients that a format lacks, by Brown's coefficients that it stores ----


def within_brown(rig: StereoRig, terms: tuple[str, ...]) -> tuple[StereoRig, str]:
    """The rig without a lens field and with these coefficients only, and the error of this in words.

    Of each camera fx, fy, cx, cy and the coefficients are fitted to the images of rays through the whole image. If the
    rig needs only these coefficients, it is returned unchanged, with "".
    """
    lost = [name for name in BROWN if name not in terms and any(c.distortion[BROWN.index(name)] for c in rig.cameras)]
    if rig.lens_field is None and not lost:
        return rig, ""
    cameras, moved = zip(*(_refitted(rig, number, terms) for number in (0, 1)), strict=True)
    beyond = ["the lens field"] * (rig.lens_field is not None) + lost
    rms, most = np.sqrt(np.mean(np.concatenate(moved) ** 2)), np.abs(np.concatenate(moved)).max()
    words = f"{' and '.join(beyond)} fitted by fx fy cx cy {' '.join(terms)}: images differ by {rms:.2g} px rms"
    words += f", {most:.2g} at most"
    return replace(rig, left=cameras[0], right=cameras[1], lens_field=None), words


def _refitted(rig: StereoRig, number: int, terms: tuple[str, ...]) -> tuple[Camera, Array]:
    """The fitted camera, and the shifts (n, 2) [px] of the images of rays."""
    camera, field = rig.cameras[number], rig.lens_field
    free = np.array([True] * 4 + [name in terms for name in BROWN])  # fx, fy, cx, cy are
    x, y = (np.linspace(0, size - 1, 40) for size in camera.image_size)
    seen = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    flat = normalise(seen if field is None else seen - field.displacement(seen, number), camera)
    good = np.isfinite(flat).all(axis=1)
    rays, seen = np.column_stack([flat, np.ones(len(flat))])[good], seen[good]
    values = np.where(free, camera.parameters, 0.0)
    for _ in range(20):  # Gauss-Newton steps
        found, _, slopes = project_with_jacobians(rays, Camera.from_parameters(values, camera.image_size))
        J = slopes[..., free].reshape(found.size, -1)
        values[free] += np.linalg.lstsq(J, (seen - found).ravel(), rcond=None)[0]
    fitted = Camera.from_parameters(values, camera.image_size)
    return fitted, project_with_jacobians(rays, fitted)[0] - seen
