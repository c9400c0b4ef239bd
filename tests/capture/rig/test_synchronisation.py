"""Offsets by sound: claps through AAC, films that begin elsewhere, cameras that hear nothing in common."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.films import cut_copy, spoil
from scgs_warp.capture.rig.sound import RATE, Sound, read_sound
from scgs_warp.capture.rig.synchronisation import PairOffset, solve, synchronise
from scgs_warp.data.synthetic.films.encoding import write_film
from scgs_warp.data.synthetic.films.sound import SAMPLE_RATE, clap_shapes, clap_times, heard
from scgs_warp.errors import UserError

FPS = 30.0


def record(folder, starts, seconds: float = 4.0, distances=None, seed: int = 0):
    """Films of some frames, whose cameras heard the same claps."""
    rng = np.random.default_rng(seed)
    times = clap_times(seconds + max(starts), rng)
    shapes = clap_shapes(len(times), rng)
    files = []
    for index, start in enumerate(starts):
        distance = 3.0 if distances is None else distances[index]
        sound = heard(times, shapes, start, seconds, distance, np.random.default_rng([seed, index]))
        files.append(folder / f"cam{index}.mp4")
        picture = np.full((64, 64, 3), 90, np.uint8)
        write_film(files[-1], [picture] * round(seconds * 10), 10.0, 30, sound)
    return files


def test_offsets_up_to_half_a_second_are_found_to_half_a_frame(tmp_path):
    starts = np.array([0.13, 0.0, 0.5, 0.371, 0.222, 0.45])
    files = record(tmp_path, starts)
    clock = synchronise([read_sound(file) for file in files])
    assert np.abs(clock.starts - starts).max() < 0.002 < 0.5 / FPS and clock.disagreement < 0.001


def test_distances_shift_by_the_speed_of_sound_alone(tmp_path):
    starts, distances = np.array([0.0, 0.3, 0.2]), np.array([2.0, 5.0, 3.0])
    clock = synchronise([read_sound(file) for file in record(tmp_path, starts, distances=distances)])
    expected = starts - distances / 343.0
    assert np.abs(clock.starts - (expected - expected.min())).max() < 0.002
    assert np.abs(clock.starts - starts).max() < 0.5 / FPS


def test_sound_is_on_the_clock_of_the_first_picture(tmp_path):
    """A file whose pictures begin 0.8 s later than its sound."""
    import av

    rng, late = np.random.default_rng(0), tmp_path / "late.mp4"
    sound = heard(np.array([1.5]), clap_shapes(1, rng), 0.0, 3.0, 1.0, rng)
    with av.open(str(late), "w") as container:
        video = container.add_stream("libx264", rate=10)
        video.width = video.height = 64
        audio = container.add_stream("aac", rate=SAMPLE_RATE, layout="mono")
        for number in range(20):
            frame = av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), format="rgb24")
            frame.pts = number + 8
            container.mux(video.encode(frame))
        container.mux(video.encode())
        whole = av.AudioFrame.from_ndarray(sound[None], format="fltp", layout="mono")
        whole.sample_rate, whole.pts = SAMPLE_RATE, 0
        for piece in av.AudioResampler("fltp", "mono", SAMPLE_RATE, frame_size=1024).resample(whole):
            container.mux(audio.encode(piece))
        container.mux(audio.encode())
    found = read_sound(late)
    assert found is not None
    clap = found.start + np.abs(found.samples).argmax() / RATE
    assert clap == pytest.approx(1.5 + 1 / 343 - 0.8, abs=0.01)


def noise(seed: int, seconds: float = 4.0) -> Sound:
    return Sound(np.random.default_rng(seed).normal(0, 0.1, round(seconds * RATE)).astype(np.float32), 0.0)


def test_clocks_may_run_at_different_rates():
    """In a minute of a quiet room, 20 parts in a million spread the peak over a millisecond."""
    rng, count, rate = np.random.default_rng(0), 60 * RATE, 1.00002
    heard_by_both = rng.normal(0.0, 1.0, count)
    own = rng.normal(0.0, 3.0, (2, count))
    other = np.interp(np.arange(count - RATE) * rate + 0.5 * RATE, np.arange(count), heard_by_both)
    sounds = [heard_by_both + own[0], other + own[1, : len(other)]]
    clock = synchronise([Sound(sound.astype(np.float32), 0.0) for sound in sounds])
    assert clock.starts[0] == 0 and 0.5 <= clock.starts[1] <= 0.5 + 60 * (rate - 1)


def test_cameras_that_hear_something_else_get_no_start(tmp_path):
    files = record(tmp_path, [0.0, 0.2, 0.4])
    clock = synchronise([read_sound(files[0]), noise(5), read_sound(files[1]), None, read_sound(files[2])])
    assert np.isnan(clock.starts[[1, 3]]).all()
    np.testing.assert_allclose(clock.starts[[0, 2, 4]], [0.0, 0.2, 0.4], atol=0.002)
    silence = Sound(np.zeros(3 * RATE, np.float32), 0.0)
    assert np.isnan(synchronise([silence, silence, noise(1)]).starts).all()
    assert np.isnan(synchronise([noise(k) for k in range(6)]).starts).all()
    assert np.isnan(synchronise([None, None]).starts).all()


def test_one_wrong_pair_does_not_move_the_clock():
    true = np.array([0.1, 0.0, 0.4, 0.25, 0.31])
    pairs = [PairOffset(a, b, true[b] - true[a], 20.0) for a in range(5) for b in range(a + 1, 5)]
    pairs[3] = pairs[3]._replace(seconds=pairs[3].seconds + 1.7)
    clock = solve(5, pairs)
    assert np.abs(clock.starts - true).max() < 0.004 and clock.disagreement < 0.004


def test_many_cameras_are_compared_with_some_others():
    rng = np.random.default_rng(3)
    room = rng.normal(0, 0.2, 4 * RATE).astype(np.float32)
    shifts = rng.integers(0, RATE // 2, 15)
    sounds = [Sound(room[shift : shift + 3 * RATE], 0.0) for shift in shifts]
    found = synchronise(sounds).starts
    np.testing.assert_allclose(found, (shifts - shifts.min()) / RATE, atol=1e-3)


def test_sound_before_damage_is_used(tmp_path):
    """Of a copy that was cut off, or whose later part is damaged; too little is refused."""
    starts = np.array([0.13, 0.0, 0.3])
    files = record(tmp_path, starts, seconds=6.0)
    cut_copy(files[1], tmp_path / "cut.mp4", 0.7)
    spoil(files[2], 0.55, 0.2)
    sounds = [read_sound(file) for file in (files[0], tmp_path / "cut.mp4", files[2])]
    assert all(sound is not None and 2.0 < len(sound.samples) / RATE < 5.0 for sound in sounds[1:])
    assert np.abs(synchronise(sounds).starts - starts).max() < 0.002
    cut_copy(files[1], tmp_path / "cut.mp4", 0.15)
    with pytest.raises(UserError, match=r"cut\.mp4: its sound does not decode .*--offsets"):
        read_sound(tmp_path / "cut.mp4")


def test_a_film_without_sound_has_none(tmp_path):
    write_film(tmp_path / "mute.mp4", [np.zeros((64, 64, 3), np.uint8)] * 8, 10.0, 30, None)
    assert read_sound(tmp_path / "mute.mp4") is None
    assert SAMPLE_RATE == 48_000


@pytest.mark.parametrize("kept", [0.7, 1.3])
def test_films_that_have_less_than_a_second_in_common_are_not_guessed(tmp_path, kept):
    """Where too little overlaps, another clap may look alike."""
    starts = np.array([0.0, 0.6, 0.5, 0.65])
    sounds = [read_sound(file) for file in record(tmp_path, starts)]
    first = sounds[0]
    assert first is not None
    sounds[0] = first._replace(samples=first.samples[: round(kept * RATE)])
    clock = synchronise(sounds)
    assert np.isnan(clock.starts[0])
    assert np.abs(clock.starts[1:] - (starts[1:] - 0.5)).max() < 0.002
