"""Lenses of simulated cameras from films of a chessboard."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.perception.calibration import load_calibration

CORNERS, SQUARE_PX = (8, 5), 40


def board() -> np.ndarray:
    """Squares with a white border."""
    columns, rows = CORNERS[0] + 1, CORNERS[1] + 1
    squares = (np.indices((rows, columns)).sum(axis=0) % 2 * 255).astype(np.uint8)
    return np.pad(np.kron(squares, np.ones((SQUARE_PX, SQUARE_PX), np.uint8)), SQUARE_PX, constant_values=255)


def filmed(folder: Path, focal: float, size: tuple[int, int], distortion: list[float], tilt: float = 0.5) -> Path:
    """Pictures of the board from several sides, by a lens."""
    rng, picture = np.random.default_rng(1), board()
    height, width = picture.shape
    matrix = np.array([[focal, 0, size[0] / 2 + 7], [0, focal, size[1] / 2 - 5], [0, 0, 1]])
    # Every pixel of the lens, as a ray without distortion.
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    rays = cv2.undistortPoints(grid, matrix, np.array(distortion)).reshape(-1, 2)
    folder.mkdir()
    for number in range(14):
        turn = exp_so3(np.array([*rng.uniform(-tilt, tilt, 2), rng.uniform(-0.3, 0.3)]))
        away = focal * 1.15 * width / size[0] * rng.uniform(1.0, 1.4)
        place = np.array([*rng.uniform(-0.12, 0.12, 2) * width, away])
        flat = np.column_stack([turn[:, 0], turn[:, 1], place])  # board (px, about its middle) -> camera
        back = np.column_stack([rays, np.ones(len(rays))]) @ np.linalg.inv(flat).T
        on = (back[:, :2] / back[:, 2:] + [width / 2, height / 2]).reshape(size[1], size[0], 2).astype(np.float32)
        image = cv2.remap(picture, on[..., 0], on[..., 1], cv2.INTER_AREA, borderValue=128)
        cv2.imwrite(str(folder / f"{number:02d}.png"), cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    return folder


@pytest.mark.parametrize(
    ("focal", "size", "distortion"),
    [
        (520.0, (640, 480), [-0.2, 0.05, 0.0, 0.0]),
        (900.0, (720, 1280), [0.1, -0.2, 0.001, 0.0]),
        (700.0, (960, 540), [0.0] * 4),
    ],
)
def test_lens_is_found_and_read_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], focal: float, size: tuple[int, int], distortion: list[float]
) -> None:
    film = filmed(tmp_path / "board", focal, size, distortion)
    out = tmp_path / "camera.yaml"
    assert main(["calibrate", str(film), "--corners", "8x5", "--out", str(out)]) == 0
    assert "focal length" in capsys.readouterr().out
    camera = load_calibration(out)
    assert (camera.width, camera.height) == size
    assert camera.matrix[[0, 1], [0, 1]] == pytest.approx([focal, focal], rel=0.01)
    assert camera.matrix[:2, 2] == pytest.approx([size[0] / 2 + 7, size[1] / 2 - 5], abs=6.0)
    # What counts are places in the picture: those of a ring half-way to the corner.
    ring = 0.25 * np.array([[size[0], size[1]], [-size[0], size[1]], [size[0], -size[1]]]) / focal
    rays = np.column_stack([ring, np.ones(3)])
    lens = np.array([[focal, 0, size[0] / 2 + 7], [0, focal, size[1] / 2 - 5], [0, 0, 1]])
    true, found = (
        cv2.projectPoints(rays, np.zeros(3), np.zeros(3), m, np.array(d))[0]
        for m, d in ((lens, distortion), (camera.matrix, camera.distortion))
    )
    assert np.abs(true - found).max() < 2.0


@pytest.mark.parametrize(
    ("corners", "tilt", "words"),
    [("7x5", 0.5, "of a whole board with 7x5"), ("8x5", 0.0, "from several sides"), ("8", 0.5, "columns x rows")],
)
def test_what_gives_no_lens_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], corners: str, tilt: float, words: str
) -> None:
    film = filmed(tmp_path / "board", 520.0, (640, 480), [0.0] * 4, tilt)
    assert main(["calibrate", str(film), "--corners", corners, "--out", str(tmp_path / "camera.yaml")]) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
    assert not (tmp_path / "camera.yaml").exists()
