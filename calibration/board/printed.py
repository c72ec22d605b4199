"""Find printed targets in images: the corners of a chessboard, a ChArUco board, an AprilGrid, by OpenCV."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.board.geometry import Board
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, QualityError
from tofcapture.ops.pattern import Pattern, aruco_dictionary
from tofcapture.poses import Float64, transform

WIDE = 960  # px; smaller images are enlarged before corners are looked for
FEWEST = 6  # corners of a pose: four, and two to tell that they fit
AROUND = 0.7  # squares about a corner that are compared with the pattern
FINE = 5  # samples along each side of a pixel
STRAY = (
    0.01  # image widths off the homography of all, distortion included, at which a corner is another one's
)
SETTLED = 0.2  # px that a fitted corner may still move
OUTLYING = (
    6.0  # times the median distance from where all corners say one belongs, at which it is another one's
)
LEAST_STRAY = 0.15  # px
BENDABLE = 24  # corners that tell a lens's bend: ten numbers a coordinate


def corners_in(image: NDArray[Any], pattern: Pattern) -> tuple[Float64, Float64]:
    """Find the corners of a pattern in a grey image (H, W) of any type: pixels (N, 2), and places (N, 2) on the pattern, metres.

    :class:`QualityError` where fewer than six are found, or those found lie on no plane's image.
    """
    import cv2

    grey, larger = _enlarged(image)
    find = {"chessboard": _chessboard, "charuco": _charuco, "aprilgrid": _april}[pattern.kind]
    pixels, at = find(grey, pattern)
    if len(pixels) >= FEWEST:
        H, _ = cv2.findHomography(at, pixels, cv2.RANSAC, STRAY * grey.shape[1])
        good = _off(H, at, pixels) < STRAY * grey.shape[1] if H is not None else np.zeros(len(at), dtype=bool)
        pixels, at = pixels[good], at[good]
    if len(pixels) < FEWEST or np.linalg.matrix_rank(at - at.mean(axis=0), tol=pattern.square / 4) < 2:
        raise QualityError(
            f"{pattern.kind} of {pattern.columns} x {pattern.rows}: expected at least {FEWEST} corners, got {len(pixels)}",
            hint="whole in the image, evenly lit, sharp; columns and rows count squares, of an AprilGrid tags; the dictionary?",
        )
    pixels = (pixels + 0.5) / larger - 0.5
    if larger > 1 or pattern.kind == "aprilgrid":
        start = _smooth(pixels, at) if pattern.kind == "aprilgrid" else pixels
        found, settled = _fitted(np.asarray(image, dtype=np.float64), pattern, start, at)
        pixels, at = (found[settled], at[settled]) if settled.sum() >= FEWEST else (pixels, at)
    off = np.linalg.norm(pixels - _smooth(pixels, at), axis=1)
    good = off < max(OUTLYING * float(np.median(off)), LEAST_STRAY)
    return pixels[good], at[good]


def _smooth(pixels: Float64, at: Float64) -> Float64:
    """Where corners (N, 2) belong by what all of them say: a plane's image, bent by a lens as a polynomial of third degree."""
    import cv2

    H, _ = cv2.findHomography(at, pixels)
    flat = cv2.perspectiveTransform(at[:, None], H)[:, 0]
    if len(at) < BENDABLE:
        return np.asarray(flat)
    x, y = ((flat - flat.mean(axis=0)) / np.ptp(flat, axis=0).max()).T
    columns = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)
    off, weight = pixels - flat, np.ones((len(at), 1))
    for _ in range(10):
        bend = columns @ np.linalg.lstsq(columns * weight, off * weight, rcond=None)[0]
        left = np.linalg.norm(off - bend, axis=1, keepdims=True)
        weight = 1 / (1 + np.square(left / max(2 * float(np.median(left)), 1e-6)))
    return np.asarray(flat + bend)


def _fitted(
    image: Float64, pattern: Pattern, pixels: Float64, at: Float64
) -> tuple[Float64, NDArray[np.bool_]]:
    """Shift corners to where the pattern about each, as pixels see it, fits the image; and which (N,) have come to rest.

    In small images what stands beside a corner, a marker in a ChArUco board, reaches into every window that is large enough.
    """
    import cv2

    H, _ = cv2.findHomography(pixels, at)
    step = float(np.sqrt(np.abs(np.linalg.det(_slope(H, pixels))).mean()))  # metres a pixel
    reach = int(np.clip(AROUND * pattern.square / step, 2, 8))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    fine = (np.arange(FINE) + 0.5) / FINE - 0.5
    dy, dx = np.meshgrid(fine, fine, indexing="ij")
    about = np.stack([u[..., None] + dx.reshape(-1), v[..., None] + dy.reshape(-1)], axis=-1)
    out, settled = pixels.copy(), np.zeros(len(pixels), dtype=bool)
    for _ in range(6):
        for k, (pixel, place) in enumerate(zip(out, at, strict=True)):
            row, column = np.rint(pixel[::-1]).astype(int)
            part = image[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
            if part.shape != v.shape or not np.isfinite(part).all():
                continue
            samples = (about + np.array([column, row])).reshape(-1, 1, 2)
            mapped = cv2.perspectiveTransform(np.concatenate([samples, pixel[None, None]]), H)[:, 0]
            shade = pattern.dark(mapped[:-1] - mapped[-1] + place).reshape(*v.shape, -1).mean(axis=-1)
            down, across = np.gradient(shade)
            J = np.stack([np.ones(v.shape), u, v, shade, across, down], axis=-1).reshape(-1, 6)
            x = np.linalg.lstsq(J, part.reshape(-1), rcond=None)[0]
            shift = -x[4:] / x[3] if abs(x[3]) > 1e-9 else np.zeros(2)
            out[k] = pixel + np.clip(shift, -1, 1)
            settled[k] = np.abs(shift).max() < SETTLED
    return out, settled & (np.abs(out - pixels).max(axis=1) < reach)


def _slope(H: Any, points: Float64) -> Float64:
    """Derivative (N, 2, 2) of a homography at points (N, 2)."""
    import cv2

    ends = [points, *(points + d for d in np.eye(2))]
    here, right, below = (cv2.perspectiveTransform(p[:, None], H)[:, 0] for p in ends)
    return np.stack([right - here, below - here], axis=-1)


def printed_pose(pixels: Float64, at: Float64, board: Board, camera: Camera) -> Float64:
    """Compute ``T_camera_board`` (4, 4) of corners ``at`` (N, 2) seen at pixels (N, 2): a start, good to millimetres."""
    import cv2

    rays = np.ascontiguousarray(camera.rays_at(pixels)[:, :2])
    corners = np.column_stack([at, np.zeros(len(at))])
    _, turns, shifts, _ = cv2.solvePnPGeneric(corners, rays, np.eye(3), np.zeros(0), flags=cv2.SOLVEPNP_IPPE)
    R = cv2.Rodrigues(turns[0])[0]
    return transform(R, shifts[0].reshape(3) - board.thickness * R[:, 2])


def read_corners(
    paths: Sequence[Path], board: Board, progress: Callable[[str, int, int], None]
) -> tuple[tuple[int, int], dict[Path, tuple[Float64, Float64]], list[str]]:
    """Find a printed board in image files: their width and height, pixels and places by file, and why others have none.

    :class:`DataError` for a file that is no image or of another size, and for a board with nothing printed on it.
    """
    import cv2

    if board.pattern is None:
        raise DataError(
            f"board {board.name!r}: expected a printed board for images, got cut-outs alone",
            hint="--board charuco, chessboard or aprilgrid, a TOML file with a [pattern], or chessboard:10x7:0.025",
        )
    size, found, refused = None, {}, []
    for i, path in enumerate(paths):
        progress("images", i, len(paths))
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
        if image is None:
            raise DataError(f"{path}: expected an image, cannot be decoded")
        size = size or (image.shape[1], image.shape[0])
        if size != (image.shape[1], image.shape[0]):
            raise DataError(
                f"{path}: expected images of one camera, {size[0]} x {size[1]}, got {image.shape[1]} x {image.shape[0]}"
            )
        try:
            found[path] = corners_in(image, board.pattern)
        except QualityError as err:
            refused.append(f"{path.name} {err}")
    if not found or size is None:
        raise DataError(
            f"no board in {len(paths)} images, the first: {refused[0]}",
            hint="columns, rows and dictionary of the board? the whole board in the image, sharp?",
        )
    return size, found, refused


def start_camera(seen: Sequence[tuple[Float64, Float64]], size: tuple[int, int]) -> Camera:
    """Guess a pinhole from corners by OpenCV, good to some per cent; :class:`DataError` where views are too few or too alike."""
    import cv2

    at = [np.column_stack([a, np.zeros(len(a))]).astype(np.float32) for _, a in seen]
    pixels = [p.astype(np.float32)[:, None] for p, _ in seen]
    try:
        _, K, _, _, _ = cv2.calibrateCamera(at, pixels, size, None, None, flags=cv2.CALIB_FIX_K3)
        return Camera(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    except (cv2.error, ConfigError) as err:
        raise DataError(
            f"lens: {len(seen)} images do not tell a focal length: {err}",
            hint="take five or more, the board tilted 20 to 40 degrees in all directions, also in the corners of the image",
        ) from err


def _enlarged(image: NDArray[Any]) -> tuple[NDArray[np.uint8], int]:
    """Stretch to eight bits, and enlarge small images by a whole number."""
    import cv2

    values = np.nan_to_num(np.asarray(image, dtype=np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    low, high = np.percentile(values, (0.5, 99.5))
    grey = np.clip(255 * (values - low) / max(high - low, 1e-9), 0, 255)
    larger = max(1, -(-WIDE // max(values.shape[1], 1)))
    size = (values.shape[1] * larger, values.shape[0] * larger)
    return np.rint(np.clip(cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC), 0, 255)).astype(
        np.uint8
    ), larger


def _chessboard(grey: NDArray[np.uint8], pattern: Pattern) -> tuple[Float64, Float64]:
    """Find all inner corners, in the order that puts dark squares where the pattern has them."""
    import cv2

    columns, rows = pattern.columns - 1, pattern.rows - 1
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    flags |= cv2.CALIB_CB_LARGER
    for scale in (1.0, 0.5):  # smooth enlarged images are found when smaller
        cv2.setRNGSeed(0)  # the library draws, and may else take a part of a board for the whole
        smaller = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        found, seen, squares = cv2.findChessboardCornersSBWithMeta(smaller, (columns, rows), flags)
        if found:
            break
    else:
        return np.zeros((0, 2)), np.zeros((0, 2))
    if squares.shape not in {(rows, columns), (columns, rows)}:
        raise QualityError(
            f"chessboard of {pattern.columns} x {pattern.rows}: the one in the image has {squares.shape[1] + 1} x {squares.shape[0] + 1}",
            hint="columns and rows count squares, not corners between them",
        )
    grid = (seen.reshape(rows, columns, 2).astype(np.float64) + 0.5) / scale - 0.5
    orders = [grid, grid[::-1, ::-1], grid[::-1], grid[:, ::-1]]
    if rows == columns:
        orders += [g.swapaxes(0, 1) for g in orders]
    # Rows run clockwise of columns as the front is looked at; the rest is told by the squares.
    right = [g for g in orders if np.linalg.det([g[0, -1] - g[0, 0], g[-1, 0] - g[0, 0]]) > 0]
    best = max(right, key=lambda g: _contrast(grey, g.reshape(-1, 2), pattern))
    return best.reshape(-1, 2), pattern.corners


def _contrast(grey: NDArray[np.uint8], pixels: Float64, pattern: Pattern) -> float:
    """How much brighter the light squares are than the dark ones, where these corners are the pattern's."""
    import cv2

    half = pattern.square / 2
    centres = np.concatenate(
        [pattern.corners + np.array([dx, dy]) for dx in (-half, half) for dy in (-half, half)]
    )
    H, _ = cv2.findHomography(pattern.corners, pixels)
    u, v = np.rint(cv2.perspectiveTransform(centres[:, None], H)[:, 0]).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < grey.shape[1]) & (v < grey.shape[0])
    seen, dark = grey[v[inside], u[inside]].astype(float), pattern.dark(centres)[inside]
    return float(seen[~dark].mean() - seen[dark].mean()) if dark.any() and not dark.all() else -np.inf


def _charuco(grey: NDArray[np.uint8], pattern: Pattern) -> tuple[Float64, Float64]:
    """Find the inner corners that stand between markers."""
    import cv2

    book = aruco_dictionary(pattern.dictionary)
    size = (pattern.columns, pattern.rows)
    board = cv2.aruco.CharucoBoard(size, pattern.square, pattern.marker, book)
    board.setLegacyPattern(pattern.legacy)
    corners = cv2.aruco.CharucoParameters()
    corners.tryRefineMarkers = True
    detector = cv2.aruco.CharucoDetector(board, corners, _parameters(pattern.border))
    pixels, numbers, _, _ = detector.detectBoard(grey)
    if numbers is None or not len(numbers):
        return np.zeros((0, 2)), np.zeros((0, 2))
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2), pattern.corners[
        np.asarray(numbers).reshape(-1)
    ]


def _april(grey: NDArray[np.uint8], pattern: Pattern) -> tuple[Float64, Float64]:
    """Find the corners of tags. Libraries start at different corners of a tag: the start that lies on a plane is taken for all.

    The library's own refinement is not asked: it jumps to the squares that stand between tags.
    """
    import cv2

    detector = cv2.aruco.ArucoDetector(aruco_dictionary(pattern.dictionary), _parameters(pattern.border))
    corners, numbers, _ = detector.detectMarkers(grey)
    known = (
        [] if numbers is None else [(c, int(n)) for c, n in zip(corners, numbers.reshape(-1), strict=True)]
    )
    known = [(c, n) for c, n in known if n < pattern.columns * pattern.rows]
    if not known:
        return np.zeros((0, 2)), np.zeros((0, 2))
    pixels = np.concatenate([np.asarray(c, dtype=np.float64).reshape(4, 2) for c, _ in known])
    places = pattern.corners.reshape(-1, 4, 2)[[n for _, n in known]]

    def misfit(start: int) -> float:
        at = np.roll(places, -start, axis=1).reshape(-1, 2)
        H, _ = cv2.findHomography(at, pixels)
        return np.inf if H is None else float(np.median(_off(H, at, pixels)))

    start = min(range(4), key=misfit)
    return pixels, np.roll(places, -start, axis=1).reshape(-1, 2)


def _parameters(border: int) -> Any:
    import cv2

    out = cv2.aruco.DetectorParameters()
    out.markerBorderBits = border
    out.minMarkerPerimeterRate = 0.01
    return out


def _off(H: Any, at: Float64, pixels: Float64) -> Float64:
    """Distances (N,) of pixels to where a homography puts places."""
    import cv2

    return np.asarray(np.linalg.norm(cv2.perspectiveTransform(at[:, None], H)[:, 0] - pixels, axis=1))
