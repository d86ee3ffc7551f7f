import numpy as np
import pytest

from app.lifting.evidence import OUTLIER_SIGMA_PX, Evidence

RNG = np.random.default_rng(5)
NOISE_VAR = np.square((1.0, 3.0, 9.0))


def log_density(innovation: np.ndarray, covariance: np.ndarray) -> float:
    """Of a Gaussian, up to (2π)."""
    _, log_determinant = np.linalg.slogdet(covariance)
    return -0.5 * float(log_determinant + innovation @ np.linalg.solve(covariance, innovation))


def drawn(n: int, elsewhere_px: float) -> tuple[np.ndarray, np.ndarray]:
    """A prior, and an innovation of it and a noise of 3 px, but for one joint that is elsewhere."""
    spread = RNG.normal(size=(2 * n, 2 * n)) * 4.0
    prior = spread @ spread.T
    innovation = np.linalg.cholesky(prior + 9.0 * np.eye(2 * n)) @ RNG.normal(size=2 * n)
    innovation[6:8] += elsewhere_px
    return prior, innovation


def log_odds(prior: np.ndarray, innovation: np.ndarray) -> np.ndarray:
    """Every joint left out in turn, at every noise level, against all joints: written out."""
    size = len(innovation)
    levels = [prior + var * np.eye(size) for var in NOISE_VAR]
    everybody = np.logaddexp.reduce([log_density(innovation, level) for level in levels])
    odds = []
    for joint in range(size // 2):
        here = np.array([2 * joint, 2 * joint + 1])
        rest = np.delete(np.arange(size), here)
        scores = []
        for level in levels:
            solved = np.linalg.solve(level[np.ix_(rest, rest)], innovation[rest])
            off = innovation[here] - level[np.ix_(here, rest)] @ solved
            outside = -0.5 * off @ off / OUTLIER_SIGMA_PX**2 - np.log(OUTLIER_SIGMA_PX**2)
            scores.append(log_density(innovation[rest], level[np.ix_(rest, rest)]) + outside)
        odds.append(np.logaddexp.reduce(scores) - everybody)
    return np.array(odds)


@pytest.mark.parametrize("elsewhere_px", [0.0, 60.0, 3000.0])
def test_the_suspect_is_whom_plain_densities_accuse(elsewhere_px: float) -> None:
    """Also beyond exp(-745)."""
    n, prior_wrong = 6, 0.06
    prior, innovation = drawn(n, elsewhere_px)
    odds = log_odds(prior, innovation)
    worst = int(np.argmax(odds))
    wanted = worst if odds[worst] + np.log(prior_wrong / (1 - prior_wrong)) > 0 else None
    found = Evidence(prior, innovation, NOISE_VAR).suspect(np.ones(n), prior_wrong)
    assert found == wanted
    assert found == (3 if elsewhere_px else None)


@pytest.mark.parametrize("elsewhere_px", [0.0, 20.0])
def test_a_joint_is_suspected_from_the_doubt_on_that_outweighs_the_others(
    elsewhere_px: float,
) -> None:
    prior, innovation = drawn(6, elsewhere_px)
    evidence = Evidence(prior, innovation, NOISE_VAR)
    for joint, odds in enumerate(log_odds(prior, innovation)):
        for nudge in (-0.01, 0.01):
            confidence = np.ones(6)
            confidence[joint] = 1.0 - 1.0 / (1.0 + np.exp(odds - nudge))
            found = evidence.suspect(confidence, 1e-30)
            assert found == (joint if nudge > 0 else None)


def test_rounding_makes_no_noise_negative() -> None:
    """Of a prior that is all in one direction, however large."""
    direction = RNG.normal(size=12)
    prior = 1e16 * np.outer(direction, direction)
    evidence = Evidence(prior, np.zeros(12), NOISE_VAR)
    assert np.isfinite(evidence.mean_precision).all()
    assert NOISE_VAR.min() <= evidence.mean_noise_var <= NOISE_VAR.max()


def test_whom_the_network_doubts_is_suspected_sooner() -> None:
    n = 6
    innovation = np.zeros(2 * n)
    innovation[4:6] = 18.0
    evidence = Evidence(4.0 * np.eye(2 * n), innovation, np.array([36.0]))
    sure = np.full(n, 0.99)
    assert evidence.suspect(sure, 0.001) is None
    doubted = sure.copy()
    doubted[2] = 0.3
    assert evidence.suspect(doubted, 0.001) == 2
    doubted[[2, 3]] = 0.99, 0.3
    assert evidence.suspect(doubted, 0.001) is None, "it is where it should be"
