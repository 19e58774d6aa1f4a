"""When inputs rest: laws of units, noise, clocks, holes and the length of the record."""

import numpy as np
import pytest
from scipy import signal

from sklearn_hd.algorithms.signals.trim import changes, energy_by_turn, inputs_rest, rests

TURN = 2.0 * np.pi


def azimuth(n_turns, samples=16.0):
    return TURN * np.arange(int(n_turns * samples)) / samples


def doublet(psi, start=5.0):
    turns = psi / TURN
    return 1.0 * ((turns >= start) & (turns < start + 2)) - (
        (turns >= start + 2) & (turns < start + 4)
    )


def noise(psi, size, seed=0):
    return size * np.random.default_rng(seed).standard_normal(len(psi))


def rest(psi, *inputs):
    return inputs_rest([np.column_stack(inputs)], [psi])


@pytest.mark.parametrize("scale", [1e-150, 1e-6, 1e6, 1e150])
def test_units_do_not_matter(scale):
    psi = azimuth(60)
    moves = noise(psi, 1.0)
    assert rest(psi, scale * doublet(psi), 3.0 / scale * doublet(psi, 20.0))
    assert not rest(psi, scale * doublet(psi), moves / scale)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.05])
@pytest.mark.parametrize("n_turns", [20, 200, 2000])
def test_how_long_a_noisy_record_rests_does_not_matter(n_turns, size):
    psi = azimuth(n_turns)
    assert rest(psi, doublet(psi) + noise(psi, size))


@pytest.mark.parametrize("trim", [0.0, 1.0, 100.0])
@pytest.mark.parametrize("samples", [7.3, 16.0, 16.3, 64.02])
def test_neither_a_waveform_of_the_turn_nor_the_clock_is_motion(samples, trim):
    """A torque U cos ψ whose amplitude is stepped by a hundredth."""
    psi = azimuth(60, samples)
    wave = trim * np.cos(psi + 0.3)
    assert rest(psi, doublet(psi) + wave, np.full(len(psi), 7.0), wave)
    assert not rest(psi, noise(psi, 1.0) + wave)


def test_a_speed_that_varies_is_no_motion():
    t = np.arange(960) / 16.0
    psi = TURN * (t + 0.8 * np.sin(0.2 * t))
    assert rest(psi, doublet(psi) + 5.0 * np.cos(psi))


@pytest.mark.parametrize(
    "moving",
    [
        lambda psi, g: g.standard_normal(len(psi)),
        lambda psi, g: np.repeat(g.standard_normal(len(psi)), 12)[: len(psi)],
        lambda psi, g: signal.sosfilt(
            signal.butter(2, 0.005, output="sos"), g.standard_normal(len(psi))
        ),
        lambda psi, g: signal.lfilter([1.0], [1.0, -0.99], g.standard_normal(len(psi))),
        lambda psi, g: np.cos(0.0131 * psi + TURN * g.random()),
        lambda psi, g: signal.chirp(psi / TURN, 0.01, psi[-1] / TURN, 5.0),
    ],
    ids=["white", "steps", "slow noise", "walk", "slow sine", "chirp"],
)
@pytest.mark.parametrize("n_turns", [20, 1000])
def test_what_always_moves_does_not_rest(moving, n_turns):
    psi = azimuth(n_turns)
    for seed in range(5):
        assert not rest(psi, moving(psi, np.random.default_rng(seed)))


def test_one_input_that_moves_is_enough():
    psi = azimuth(60)
    assert not rest(psi, doublet(psi), noise(psi, 1.0))
    assert rest(psi, doublet(psi), doublet(psi), np.zeros(len(psi)))


def test_what_never_moves_tells_nothing():
    psi = azimuth(60)
    assert not rest(psi, np.zeros(960))
    assert not rest(psi, np.full(960, 1e9))
    for samples in (16.0, 16.3, 64.02):
        assert not rest(azimuth(60, samples), np.cos(azimuth(60, samples)))


@pytest.mark.parametrize("n_turns", [0.0, 0.05, 0.5, 1.5, 5.0, 11.0])
def test_short_records_do_not_rest(n_turns):
    psi = azimuth(n_turns)
    assert not rest(psi, doublet(psi, 1.0))


@pytest.mark.parametrize("seed", range(5))
def test_holes_are_neither_motion_nor_rest(seed):
    """Single samples and whole turns that are missing, of noisy inputs too."""
    rng, psi = np.random.default_rng(seed), azimuth(200)
    known = rng.random(len(psi)) > 0.03
    for start in rng.integers(0, len(psi), 6):
        known[start : start + 60] = False
    known[1000:2800] = False  # most of the record
    still, moving = doublet(psi) + noise(psi, 0.02, seed), noise(psi, 1.0, seed)
    assert rest(psi[known], still[known])
    assert not rest(psi[known], moving[known])


def test_pieces_shorter_than_two_turns_tell_nothing():
    long, short = azimuth(14), azimuth(1.5)
    moves = [noise(long, 1.0)[:, None], *[np.zeros((len(short), 1))] * 40]
    assert not inputs_rest(moves, [long, *[short] * 40])
    assert inputs_rest([doublet(long)[:, None], *moves[1:]], [long, *[short] * 40])


def test_records_are_judged_together():
    psi = azimuth(11)
    pulses = [doublet(psi, 1.0)[:, None], doublet(psi + 1e3, 161.0)[:, None]] * 4
    assert inputs_rest(pulses, [psi, psi + 1e3] * 4)


def test_changes_are_those_within_a_turn():
    psi = azimuth(4)
    ramp = psi[:, None] / TURN
    np.testing.assert_allclose(
        changes(ramp, psi), np.sign(psi - psi.mean() + 1e-9)[:, None], rtol=1e-9
    )
    assert not changes(ramp, psi[0] + 0.4 * psi).any()  # less than two turns


def test_energy_is_a_share_of_each_signal():
    psi = azimuth(6)
    pieces = [np.column_stack([doublet(psi, 1.0), 1e9 * doublet(psi, 2.0)])] * 2
    energy, turns = energy_by_turn(pieces, [psi, psi + 55.0])
    assert sum(np.sum(e) for e in energy) == pytest.approx(2.0)
    np.testing.assert_array_equal(energy[0], energy[1])
    np.testing.assert_array_equal(turns[1], np.repeat(np.arange(6), 16))


def test_turns_like_the_quieter_half_rest():
    assert not rests(np.zeros(20)).any()
    assert not rests(np.ones(20)).any()
    assert rests(np.eye(20)[3]).sum() == 19
