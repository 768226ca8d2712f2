"""An animation shows the face before, on its way, after, and back again."""

import shutil

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.pictures import canvas, faces
from cmfsim.pictures.faces import FILM_SIZE, animate_face
from cmfsim.processes.worker import run_program

pytest.importorskip("pyvista")
image = pytest.importorskip("PIL.Image")

BALL = cmfsim.SurfaceData(*meshes.icosphere(3, 50.0))
MOVED = BALL.vertices + np.where(BALL.vertices[:, 1:2] < 0.0, (0.0, -20.0, 0.0), 0.0)


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(faces, "STEPS", 2)


def test_the_front_goes_forwards_and_comes_back(tmp_path):
    try:
        animate_face(tmp_path / "face.gif", BALL, MOVED)
    except cmfsim.CaseError as error:
        pytest.skip(f"cannot draw here: {error}")
    fronts, times = [], []
    with image.open(tmp_path / "face.gif") as gif:
        assert (gif.size, gif.n_frames) == (FILM_SIZE, 4)
        for number in range(4):
            gif.seek(number)
            times.append(gif.info["duration"])
            # The foremost column of the left view that shows skin, above its caption.
            half = np.asarray(gif.convert("RGB"))[: FILM_SIZE[1] - 60, FILM_SIZE[0] // 2 + 2 :]
            fronts.append(np.flatnonzero((half.min(axis=2) < 230).any(axis=0))[0])
    assert times == [1000, 80, 1000, 80]
    assert fronts[0] > fronts[1] > fronts[2]
    assert fronts[3] == fronts[1]


def test_a_film_gets_every_frame_as_long_as_it_is_seen(tmp_path, monkeypatch):
    """By a program in the place of ffmpeg, which returns how many bytes it was given."""
    tool = tmp_path / "ffmpeg"
    tool.write_text("#!/bin/sh\nwc -c\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setattr(canvas, "drawn", lambda *_: np.zeros((*FILM_SIZE[::-1], 3), np.uint8))
    animate_face(tmp_path / "face.mp4", BALL, MOVED)
    assert int((tmp_path / "face.mp4").read_bytes()) == 3 * FILM_SIZE[0] * FILM_SIZE[1] * (
        2 * 12 + 2
    )
    tool.write_text("#!/bin/sh\necho no such codec >&2; exit 3\n")
    with pytest.raises(
        cmfsim.CaseError, match=r"face\.mp4: ffmpeg ended with code 3: no such codec"
    ):
        animate_face(tmp_path / "face.mp4", BALL, MOVED)
    tool.write_text("#!/bin/sh\nexec sleep 60\n")
    monkeypatch.setattr(faces, "FILM_SECONDS", 0.3)
    with pytest.raises(cmfsim.CaseError, match=r"ffmpeg has not ended after 0\.3 s"):
        animate_face(tmp_path / "face.mp4", BALL, MOVED)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_a_film_of_ffmpeg_shows_the_frames_that_it_got(tmp_path, monkeypatch):
    """Grey levels: before, half of the way, after, and back; ffmpeg itself reads the film."""
    levels = iter((20, 120, 220))
    shape = (*FILM_SIZE[::-1], 3)
    monkeypatch.setattr(canvas, "drawn", lambda *_: np.full(shape, next(levels), np.uint8))
    film = tmp_path / "a film.mp4"
    animate_face(film, BALL, MOVED)
    words = ("-v", "error", "-i", str(film), "-f", "rawvideo", "-pix_fmt", "gray", "-")
    read = run_program("ffmpeg", ["ffmpeg", *words], seconds=60.0)
    pictures = np.frombuffer(read.stdout, np.uint8).reshape(-1, shape[0] * shape[1])
    expected = [20] * 12 + [120] + [220] * 12 + [120]
    assert np.allclose(pictures.mean(axis=1), expected, atol=3.0)


def test_what_cannot_be_animated_is_refused(tmp_path, monkeypatch):
    with pytest.raises(cmfsim.CaseError, match=r"an animation is written as \.gif or \.mp4"):
        animate_face(tmp_path / "face.png", BALL, MOVED)
    with pytest.raises(cmfsim.CaseError, match=r"no folder .*nowhere: make it"):
        animate_face(tmp_path / "nowhere" / "face.gif", BALL, MOVED)
    with pytest.raises(cmfsim.CaseError, match="no point of the face moves"):
        animate_face(tmp_path / "face.gif", BALL, BALL.vertices)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(cmfsim.CaseError, match="ffmpeg, which is not installed"):
        animate_face(tmp_path / "face.mp4", BALL, MOVED)
    assert not [*tmp_path.iterdir()]
