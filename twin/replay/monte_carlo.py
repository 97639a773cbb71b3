"""Success probability by Monte Carlo: replays of varied starts and settings.

Poses, frictions, forces, masses, stiffnesses and delays are varied. The same seed and the same
start draw the same variations, whatever plan is replayed, on whichever worker and in whatever
order (common random numbers: Law, Simulation Modeling and Analysis, ch. 11).
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import GstError, UsageError
from bridge.geometry import se3
from bridge.task.record import check_record
from bridge.task.task_file import ObjectModel
from bridge.task.verdict import Verdict
from twin.physics.config import PhysicsConfig
from twin.physics.unseen import Unseen
from twin.replay.config import (
    UNKNOWN_POSE_M,
    UNKNOWN_POSE_RAD,
    BoxDraw,
    PosteriorDraw,
    ReplayConfig,
)
from twin.replay.scene import ReplayScene
from twin.scene.shape.known import yaw_period_rad

YOUNG_LOG = 0.3
"""Spread of the logarithm of each soft object's Young's modulus."""
GRIP_DELAY_S = 0.1
"""The gripper lags behind the arm by up to this long, evenly drawn [s]."""
UPRIGHT = 0.98
"""Cosine of the tilt up to which an object stands."""
RESTS_M = 1e-4
"""Localisation puts what stands exactly onto the table; within this counts as exactly [m]."""
UNSURE_AXES = (0, 1, 5)
"""What is unsure of an object that stands: x, y and the turn about the vertical."""


@dataclass(frozen=True, kw_only=True)
class Variation:
    """One draw of everything that is not known exactly."""

    Ts_base_object: dict[str, Float[np.ndarray, "4 4"]]
    physics: PhysicsConfig
    grip_delay_s: float
    """How much later than the arm the gripper acts."""
    objects: dict[str, ObjectModel]
    """The task's, with the drawn masses and stiffnesses."""
    unseen: Mapping[str, Unseen] = field(default_factory=dict)
    """Edges and centres of mass of rigid objects, where a posterior has draws of them."""

    def scene(self, scene: ReplayScene) -> ReplayScene:
        """The varied start."""
        task = replace(scene.task, objects=self.objects)
        return replace(scene, task=task, Ts_base_object=self.Ts_base_object, unseen=self.unseen)

    def config(self, config: ReplayConfig) -> ReplayConfig:
        """The varied settings; a varied replay has no samples of its own."""
        return replace(config, physics=self.physics, grip_delay_s=self.grip_delay_s, samples=0)

    def to_record(self, config: ReplayConfig) -> dict[str, Any]:
        """What was drawn, as plain numbers."""
        spreads = config.variation.physics_spreads()
        soft = {key: model.soft for key, model in self.objects.items() if model.soft is not None}
        return {
            "T_base_object": {
                name: se3.pose_record(T) for name, T in sorted(self.Ts_base_object.items())
            },
            "physics": {name: getattr(self.physics, name) for name in spreads},
            "grip_delay_s": self.grip_delay_s,
            "mass_kg": {
                name: model.mass_kg for name, model in self.objects.items() if not model.fixed
            },
            "young_pa": {name: material.young_pa for name, material in soft.items()},
            "unseen": {name: asdict(unseen) for name, unseen in sorted(self.unseen.items())},
        }


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
    own = config.physics.object_friction
    physics = replace(
        config.physics,
        finger_friction=draw.finger_pair_friction / own,
        surface_friction=draw.surface_pair_friction / own,
        grip_force_N=config.physics.grip_force_N * draw.grip_scale,
    )
    known = dict(config.variation.masses)  # weighed, so nothing is left to scale
    objects = {
        name: model
        if model.fixed or name in known
        else replace(model, mass_kg=model.mass_kg * draw.mass_scale)
        for name, model in scene.task.objects.items()
    }
    poses = {}
    for name, T in scene.Ts_base_object.items():
        poses[name] = T.copy()
        poses[name][:2, 3] += draw.bias_m
    task = replace(scene.task, objects=objects)
    unseen = {box.name: _unseen(box, objects[box.name]) for box in draw.boxes}
    moved = replace(scene, task=task, Ts_base_object=poses, unseen=unseen)
    return moved, replace(config, physics=physics)


def _unseen(box: BoxDraw, model: ObjectModel) -> Unseen:
    half = np.array(model.size_m) / 2
    x, y, z = (half * box.centre_of_mass).tolist()
    return Unseen(edge_m=float(box.edge_share * half.min()), centre_of_mass_m=(x, y, z))


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
) -> Variation:
    """Draw poses from the localisation's covariance and physics from the priors.

    Where there is a posterior, what it knows of comes from its draws: the samples take turns (by
    index), so that each has as many as its weight says.

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
    return Variation(
        Ts_base_object=poses,
        physics=physics,
        grip_delay_s=delay_s,
        objects={name: objects[name] for name in scene.task.objects},
        unseen=scene.unseen,
    )


def _varied_model(model: ObjectModel, z: Float[np.ndarray, "2"], mass_log: float) -> ObjectModel:
    if model.fixed:
        return model
    soft = model.soft
    if soft is not None:
        soft = replace(soft, young_pa=soft.young_pa * float(np.exp(YOUNG_LOG * z[1])))
    mass_kg = model.mass_kg * float(np.exp(mass_log * z[0]))
    return replace(model, mass_kg=mass_kg, soft=soft)


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


SCHEMA_VERSION = 1
LEVEL = 0.95

Replay = Callable[[ReplayScene, ReplayConfig], Verdict]


@dataclass(frozen=True, kw_only=True)
class Sample:
    """What one varied replay said."""

    plan_id: str
    index: int
    variation: Mapping[str, Any]
    accepted: bool | None
    first_failing: str | None
    reason: str | None
    probability: float | None = None
    """Of success in the real cell now that this replay has said so; None: taken at its word."""

    def to_record(self) -> dict[str, Any]:
        """Return the gst sample v1 record, checked against its schema."""
        record = {
            "schema_version": SCHEMA_VERSION,
            "plan_id": self.plan_id,
            "index": self.index,
            "variation": dict(self.variation),
            "accepted": self.accepted,
            "first_failing": self.first_failing,
            "reason": self.reason,
        }
        check_record(record, name="sample")
        return record


def replay_samples(
    replay: Replay, scene: ReplayScene, config: ReplayConfig, *, plan_id: str, identity: str
) -> tuple[Sample, ...]:
    """Run ``config.samples`` varied replays; UsageError if kinematic, which moves no objects."""
    if config.samples and config.mode != "dynamic":
        message = "a kinematic replay moves no objects: it has no success probability. Use dynamic."
        raise UsageError(message)
    samples: list[Sample] = []
    for index in range(config.samples):
        rng = sample_rng(config.seed, identity, index)
        variation = draw_variation(rng, scene, config, index=index)
        samples.append(_sample(replay, scene, config, variation, plan_id, index))
    return tuple(samples)


def _sample(
    replay: Replay,
    scene: ReplayScene,
    config: ReplayConfig,
    variation: Variation,
    plan_id: str,
    index: int,
) -> Sample:
    accepted, failing, reason = None, None, None
    try:
        verdict = replay(variation.scene(scene), variation.config(config))
        accepted, failing, reason = verdict.accepted, verdict.first_failing, verdict.reason
    except GstError as error:  # this variation cannot be replayed; the others can
        reason = str(error)
    drawn, probability = config.variation.draw_at(halving(index)), None
    if drawn is not None:
        probability = 1.0 - drawn.wrong_yes if accepted is True else drawn.wrong_no
    return Sample(
        plan_id=plan_id,
        index=index,
        variation=variation.to_record(config),
        accepted=accepted,
        first_failing=failing,
        reason=reason,
        probability=probability,
    )


def with_probability(verdict: Verdict, samples: Sequence[Sample]) -> Verdict:
    """Add the share of accepted samples with its Wilson interval; without samples nothing.

    A sample that could not be decided counts among those that were not accepted. Where there is a
    posterior, each sample counts with the chance that its answer is right in this session.
    """
    if not samples:
        return verdict
    from scipy.stats import norm  # noqa: PLC0415  # half a second, and only with samples

    k, n = sum(sample.accepted is True for sample in samples), len(samples)
    value = sum(_probability(sample) for sample in samples) / n
    z = float(norm.ppf(0.5 + LEVEL / 2))
    centre = (value + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * float(np.sqrt(value * (1 - value) / n + (z / (2 * n)) ** 2))
    low, high = max(0.0, min(centre - half, value)), min(1.0, max(centre + half, value))
    return replace(verdict, p_success={"value": value, "low": low, "high": high, "k": k, "n": n})


def _probability(sample: Sample) -> float:
    return float(sample.accepted is True) if sample.probability is None else sample.probability
