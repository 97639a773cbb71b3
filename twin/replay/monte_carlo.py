"""Success probability by Monte Carlo: replays of varied starts and settings.

Poses, frictions, forces, masses, edges, stiffnesses and delays are varied. The same seed and the
same start draw the same variations, whatever plan is replayed, on whichever worker and in whatever
order (common random numbers: Law, Simulation Modeling and Analysis, ch. 11).
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import GstError, UsageError
from bridge.geometry import se3
from bridge.task.task_file import ObjectModel, Task
from bridge.task.verdict import Factor, Verdict
from twin.physics.unseen import draw_unseen
from twin.replay.config import UNKNOWN_POSE_M, UNKNOWN_POSE_RAD, PosteriorDraw, ReplayConfig
from twin.replay.deciding import LEVEL, goes_with_success, what_decides
from twin.replay.scene import ReplayScene
from twin.scene.shape.known import yaw_period_rad

YOUNG_LOG = 0.3
"""Spread of the logarithm of each soft object's Young's modulus."""
GRIP_DELAY_S = 0.1
"""The gripper lags behind the arm by up to this long, evenly drawn [s]."""
UNTRIED = (0.1, 0.55)
"""p_success before any trial: where all samples fail, and how much more where none does."""
UPRIGHT = 0.98
"""Cosine of the tilt up to which an object stands."""
RESTS_M = 1e-4
"""Localisation puts what stands exactly onto the table; within this counts as exactly [m]."""
UNSURE_AXES = (0, 1, 5)
"""What is unsure of an object that stands: x, y and the turn about the vertical."""


def sample_rng(seed: int, identity: str, index: int) -> np.random.Generator:
    """The generator of one sample: the same for one seed, start (identity) and index, anywhere."""
    digest = hashlib.sha256(f"{seed}/{identity}/{index}".encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, dtype="<u4").astype(np.uint32))


def with_draw(
    draw: PosteriorDraw, scene: ReplayScene, config: ReplayConfig
) -> tuple[ReplayScene, ReplayConfig]:
    """A start and settings as a draw has them: movers' mass, edges, centre; all objects shifted.

    The objects' own friction stays: what a draw has is that of both surfaces together.
    """
    own, surface = config.physics.object_friction, config.physics.surface_friction
    measured = "surface_friction" in dict(config.variation.calibrated)
    physics = replace(
        config.physics,
        finger_friction=draw.finger_pair_friction / own,
        surface_friction=surface if measured else draw.surface_pair_friction / own,
        grip_force_N=config.physics.grip_force_N * draw.grip_scale,
    )
    known = dict(config.variation.masses)  # weighed, so nothing is left to scale
    objects = {
        name: model
        if model.fixed or name in known
        else replace(model, mass_kg=model.mass_kg * draw.mass_scale)
        for name, model in scene.task.objects.items()
    }
    shift = se3.from_rotation(np.eye(3), (*draw.bias_m, 0.0))
    poses = {name: shift @ T for name, T in scene.Ts_base_object.items()}
    task = replace(scene.task, objects=objects)
    moved = replace(scene, task=task, Ts_base_object=poses, unseen=dict(draw.unseen))
    return moved, replace(config, physics=physics)


def rigid_movers(task: Task) -> dict[str, ObjectModel]:
    """A task's objects whose edges and centre of mass are drawn."""
    movers = {name: each for name, each in task.objects.items() if not (each.fixed or each.soft)}
    return dict(sorted(movers.items()))


def halving(index: int) -> float:
    """Share of 0 to 1 that is each next index's: 1/2, 1/4, 3/4, 1/8 ... (van der Corput 1935).

    The first so many are spread evenly, however many they are.
    """
    share, width, left = 0.0, 0.5, index + 1
    while left:
        share, left, width = share + width * (left % 2), left // 2, width / 2
    return share


def draw_variation(
    rng: np.random.Generator, scene: ReplayScene, config: ReplayConfig, *, index: int = 0
) -> tuple[ReplayScene, ReplayConfig]:
    """Draw poses from the localisation's covariance and physics from the priors.

    Where there is a posterior, what it knows of comes from its draws: the samples take turns (by
    index), so that each has as many as its weight says. Edges and centres of mass that it does not
    say are drawn. A varied replay has no samples of its own.

    Poses of different objects are drawn independently, although they share the cameras' errors.
    What stands on the table goes on standing: its height and tilt are known, so the rest is drawn
    given those. Turns that look the same are the same.
    """
    settings = config.variation
    drawn = settings.draw_at(halving(index))
    if drawn is not None:
        scene, config = with_draw(drawn, scene, config)
    factors = {
        name: float(np.exp(spread * rng.standard_normal()))
        for name, spread in settings.physics_spreads().items()
    }
    physics = replace(
        config.physics, **{name: getattr(config.physics, name) * f for name, f in factors.items()}
    )
    delay_s = config.grip_delay_s + GRIP_DELAY_S * float(rng.random())
    poses: dict[str, Float[np.ndarray, "4 4"]] = {}
    objects: dict[str, ObjectModel] = {}
    for name in sorted(scene.task.objects):
        model = scene.task.objects[name]
        # Always eight numbers, so that an object's draw does not depend on what others are.
        z = rng.standard_normal(8)
        objects[name] = _varied_model(model, z[6:], settings.mass_spread(name))
        if name in scene.Ts_base_object:
            T = scene.Ts_base_object[name]
            root = _root(T, model, scene, name)
            poses[name] = _moved(T, root @ z[:6], model)
    task = replace(scene.task, objects={name: objects[name] for name in scene.task.objects})
    unseen = {
        name: draw_unseen(np.array(model.size_m), float(rng.random()), rng.standard_normal(3))
        for name, model in rigid_movers(task).items()
    } | dict(scene.unseen)
    return (
        replace(scene, task=task, Ts_base_object=poses, unseen=unseen),
        replace(config, physics=physics, grip_delay_s=delay_s, samples=0),
    )


def _varied_model(model: ObjectModel, z: Float[np.ndarray, "2"], mass_log: float) -> ObjectModel:
    if model.fixed:
        return model
    factor, stiffer = np.exp([mass_log * z[0], YOUNG_LOG * z[1]]).tolist()
    soft = model.soft and replace(model.soft, young_pa=model.soft.young_pa * stiffer)
    return replace(model, mass_kg=model.mass_kg * factor, soft=soft)


def _root(
    T: Float[np.ndarray, "4 4"], model: ObjectModel, scene: ReplayScene, name: str
) -> Float[np.ndarray, "6 6"]:
    """Symmetric square root of what is unsure of a pose."""
    covariance = scene.covariances.get(name)
    if covariance is None:
        m, rad = UNKNOWN_POSE_M**2, UNKNOWN_POSE_RAD**2
        covariance = np.diag([m, m, 0.0, 0.0, 0.0, rad])
    rest_m = scene.table_height_m + model.rest_height_m
    if T[2, 2] > UPRIGHT and abs(T[2, 3] - rest_m) < RESTS_M:
        covariance = given_upright(covariance)
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    deviations = np.sqrt(np.maximum(values, 0.0))
    return np.asarray((vectors * deviations) @ vectors.T)


def given_upright(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Covariance of x, y and the turn once height and tilt are known; the others become zero.

    The conditional of a normal distribution (Schur complement).
    """
    keep = list(UNSURE_AXES)
    known = [index for index in range(6) if index not in UNSURE_AXES]
    across = covariance[np.ix_(keep, known)]
    inverse = np.linalg.pinv(covariance[np.ix_(known, known)], hermitian=True)
    left = np.zeros((6, 6))
    left[np.ix_(keep, keep)] = covariance[np.ix_(keep, keep)] - across @ inverse @ across.T
    return left


def _moved(
    T: Float[np.ndarray, "4 4"], step: Float[np.ndarray, "6"], model: ObjectModel
) -> Float[np.ndarray, "4 4"]:
    """Shift and turn about the object's origin; turns by a symmetry count as none."""
    turn = step[3:].copy()
    period = 2 * np.pi if model.soft is not None else yaw_period_rad(model)
    turn[2] = np.mod(turn[2] + period / 2, period) - period / 2
    moved = T.copy()
    moved[:3, :3] = se3.rotation_from_vector(turn) @ T[:3, :3]
    moved[:3, 3] += step[:3]
    return moved


def with_samples(
    verdict: Verdict,
    replay: Callable[[ReplayScene, ReplayConfig], Verdict],
    scene: ReplayScene,
    config: ReplayConfig,
    *,
    identity: str,
    until: float | None = None,  # stop once p_success is surely more or less; 0: half succeed
) -> Verdict:
    """Add the share of ``config.samples`` varied replays that succeed, with its Wilson interval.

    A sample that could not be decided or replayed counts among those that were not accepted. Each
    counts with the chance that its answer is right: by the posterior, or in cells nobody tried. A
    yes also gets what decides it as its reason. UsageError for kinematic replays.
    """
    if not config.samples:
        return verdict
    if config.mode != "dynamic":
        raise UsageError("a kinematic replay has no success probability: it moves no objects.")
    samples, drawn, total = list[Verdict](), list[dict[str, float]](), 0.0
    known = config.variation
    least, more = (0.0, 1.0) if known.posterior else UNTRIED  # draws know how far to trust them
    if until is not None:  # of the samples
        until = min(max((until - least) / more, 0.0), 1.0) if until else 0.5
    while (n := len(samples)) < config.samples:
        if until is not None and decided(total, n, until):
            break
        varied = draw_variation(sample_rng(config.seed, identity, n), scene, config, index=n)
        drawn.append(_drawn(scene, config, *varied))
        try:
            samples.append(replay(*varied))
        except GstError:  # this variation cannot be replayed; the others can
            samples.append(replace(verdict, terminal=Factor(value=None), findings=()))
        likely, good = known.draw_at(halving(n)), samples[n].accepted is True
        # Of success in the real cell, now that a sample has said so.
        total += good if likely is None else 1.0 - likely.wrong_yes if good else likely.wrong_no
    k, value = sum(sample.accepted is True for sample in samples), total / n
    shares = zip(("value", "low", "high"), (value, *wilson(value, n)), strict=True)
    verdict = replace(
        verdict,
        p_success={**{name: least + more * share for name, share in shares}, "k": k, "n": n},
        samples=_kept(samples, drawn),
    )
    if verdict.accepted is not True:
        return verdict
    strong = [text for text, strength in goes_with_success(verdict).items() if strength]
    why = (verdict.reason, *what_decides(verdict), *strong[:1])
    return replace(verdict, reason="; ".join(filter(None, why)) or None)


def _drawn(
    scene: ReplayScene, config: ReplayConfig, there: ReplayScene, varied: ReplayConfig
) -> dict[str, float]:
    """What a sample has otherwise than the nominal replay, by quantity and unit."""
    found = {"grip delay s": varied.grip_delay_s - config.grip_delay_s}
    for name, value in asdict(varied.physics).items():
        words = name.removesuffix("_N").replace("_", " ")
        found[f"{words} times"] = value / getattr(config.physics, name)
    for name, model in there.task.objects.items():
        nominal = scene.task.objects[name]
        found[f"mass of {name} times"] = model.mass_kg / nominal.mass_kg
        if model.soft is not None and nominal.soft is not None:
            found[f"stiffness of {name} times"] = model.soft.young_pa / nominal.soft.young_pa
    for name, box in there.unseen.items():
        found[f"edges of {name} m"] = box.edge_m
        for axis, off_m in zip("xyz", box.centre_of_mass_m, strict=True):
            found[f"weight of {name} off along {axis} m"] = off_m
    for name, T in there.Ts_base_object.items():
        before = scene.Ts_base_object[name]
        turned = se3.vector_from_rotation(T[:3, :3] @ before[:3, :3].T)
        for axis, shift, turn in zip("xyz", T[:3, 3] - before[:3, 3], turned, strict=True):
            found |= {f"{name} along {axis} m": shift, f"{name} turned about {axis} rad": turn}
    return found


def _kept(samples: Sequence[Verdict], drawn: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """What a verdict keeps of its samples: how each ended, and what was drawn where it varies."""
    columns = {name: [float(f"{each[name]:.3g}") for each in drawn] for name in drawn[0]}
    return {
        "accepted": [each.accepted for each in samples],
        "cause": [_cause(each) for each in samples],
        "missed_m": [_missed_m(each) for each in samples],
        "drawn": {name: values for name, values in columns.items() if len(set(values)) > 1},
    }


def _cause(sample: Verdict) -> str:
    failing = sample.factors().get(sample.first_failing or "")
    return "" if sample.accepted is True else (failing and failing.cause) or "having no answer"


def _missed_m(sample: Verdict) -> float | None:
    """By how much a sample missed its goal [m]; None where it holds or anything else failed."""
    wrong = [item.get("short_m") for item in sample.findings if item["value"] is False]
    return wrong[0] if sample.first_failing == "terminal" and len(wrong) == 1 else None


def wilson(share: float, n: int) -> tuple[float, float]:
    """The interval of a share of n (Wilson 1927), at ``LEVEL``."""
    from scipy.special import ndtri  # noqa: PLC0415

    z = float(ndtri(0.5 + LEVEL / 2))
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * float(np.sqrt(share * (1 - share) / n + (z / (2 * n)) ** 2))
    return max(0.0, min(centre - half, share)), min(1.0, max(centre + half, share))


def decided(total: float, n: int, share: float) -> bool:
    """Whether ``total`` of n succeed more or less often than a share: wrong once in 20, ever.

    How likely they are on average over all shares (Jeffreys' prior), against how likely at this
    one: at this one it is a martingale, which ever exceeds 20 once in 20 (Ville 1939; Robbins
    1970).
    """
    from scipy.special import betaln, xlog1py, xlogy  # noqa: PLC0415

    likely = xlogy(total, share) + xlog1py(n - total, -share)
    average = betaln(total + 0.5, n - total + 0.5) - betaln(0.5, 0.5)
    return bool(average - likely >= np.log(1 / (1 - LEVEL)))
