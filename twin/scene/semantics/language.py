"""From words to things: which instances and parts a text means, and by what they were found.

Words mean what the lexicon says (``twin.naming.words``). Objects of the task are known already:
their Gaussians are separate.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16

from twin.naming.things import Instance, SemanticScene, SemanticsError
from twin.naming.words import SIZES, colour_of, known_words, names_of, part_of, words_of

NAMED = "task"
"""Source of an instance that is an object of the task."""
MIN_SPLATS = 20


@dataclass(frozen=True, kw_only=True)
class Numbered:
    """Things in their final numbers."""

    labels: UInt16[np.ndarray, " num_splats"]
    """Known objects first, then what the segmenter found besides; 0 is the background."""
    keys: tuple[str, ...]
    """Of the known objects, in order: the first has the label 1."""
    others: tuple[int, ...]
    """Numbers that the segmenter gave the rest, in order."""


def numbered(
    labels: UInt16[np.ndarray, " num_splats"],
    known: Mapping[str, Bool[np.ndarray, " num_splats"]],
) -> Numbered:
    """Let the known objects have their Gaussians, and what the segmenter joined with them.

    A thing of which at least half belongs to one known object is that object: its rest is what
    was left in the background when the object was cut out. Objects with next to no Gaussians get
    no number: nothing can be said of them.
    """
    keys = tuple(key for key, mask in known.items() if int(mask.sum()) >= MIN_SPLATS)
    num_things = int(labels.max(initial=0))
    sizes = np.bincount(labels, minlength=num_things + 1)
    new_number = np.zeros(num_things + 1, dtype=np.uint16)
    most = np.zeros(num_things + 1, dtype=np.int64)
    for number, key in enumerate(keys, start=1):
        held = np.bincount(labels[known[key]], minlength=num_things + 1)
        mine = (2 * held >= sizes) & (held > most)
        new_number[mine], most[mine] = number, held[mine]
    new_number[0] = 0
    others = tuple(n for n in range(1, num_things + 1) if not new_number[n] and sizes[n])
    for number, other in enumerate(others, start=len(keys) + 1):
        new_number[other] = number
    joined = new_number[labels]
    for number, key in enumerate(keys, start=1):
        joined[known[key]] = number
    return Numbered(labels=joined, keys=keys, others=others)


CANONICAL = ("object", "thing", "stuff", "texture")
"""What a text has to beat (LERF, Kerr et al. 2023)."""
LOGIT_SCALE = 100.0
"""CLIP's trained temperature: cosines differ by hundredths."""
LEXICON = "lexicon"


@runtime_checkable
class TextEncoder(Protocol):
    """Turns texts into vectors comparable with the scene's instance embeddings."""

    @property
    def source(self) -> str:
        """Which model it is."""

    def encode(self, texts: Sequence[str]) -> Float32[np.ndarray, "num_texts num_dims"]:
        """One vector for each text, of any length but zero."""


@dataclass(frozen=True, kw_only=True)
class Query:
    """How much each thing and each part is what a text means."""

    text: str
    objects: Mapping[int, float]
    """Activation of each instance, 0..1, by its id."""
    parts: Mapping[tuple[int, str], float]
    """Activation of each part, by instance and part; empty when the text names no part."""
    source: str
    """Who says so: "lexicon" gives 0 or 1, a model something between."""
    remark: str = ""
    """Words that were not understood."""

    def best(self) -> int | None:
        """The instance with the highest activation; None when none has any."""
        top = max(self.objects, key=lambda number: (self.objects[number], -number), default=None)
        return top if top is not None and self.objects[top] > 0 else None


def query(
    scene: SemanticScene,
    text: str,
    *,
    embeddings: Float[np.ndarray, "num_instances num_dims"] | None = None,
    encoder: TextEncoder | None = None,
) -> Query:
    """Tell which instances and parts a text means.

    Without embeddings and encoder the lexicon answers: 1 where colour, size and noun fit the
    instance's label, else 0. With both, the model answers for objects: the softmax of the text
    against each canonical phrase, the smallest of them. Parts go by name in either case, each
    with its object's activation ("handle of the basket", "the duck's head").
    """
    words = words_of(text)
    if not words:
        message = f"{text!r} names nothing to look for."
        raise SemanticsError(message)
    wanted_parts, noun_words = _split_parts(scene, words)
    if embeddings is None or encoder is None:
        objects, remark = _by_lexicon(scene, noun_words)
        source = LEXICON
    else:
        phrase = " ".join(noun_words) or text
        objects, remark = _by_model(scene, phrase, embeddings, encoder), ""
        source = encoder.source
    parts = {
        (item.id, part): objects[item.id]
        for item in scene.instances
        for part in item.parts
        if part in wanted_parts
    }
    return Query(text=text, objects=objects, parts=parts, source=source, remark=remark)


def _split_parts(scene: SemanticScene, words: list[str]) -> tuple[set[str], list[str]]:
    """Parts that are named, and the words about the object."""
    parts = {part for word in words if (part := part_of(word)) is not None}
    own = {word for item in scene.instances for word in words_of(item.label)}
    rest = [word for word in words if part_of(word) is None or word in own]
    return parts, rest


def _by_lexicon(scene: SemanticScene, words: list[str]) -> tuple[dict[int, float], str]:
    own = {word for item in scene.instances for word in words_of(item.label)}
    known = known_words() | own | set(SIZES)
    unknown = [word for word in words if word not in known and colour_of(word) is None]
    objects = {item.id: float(_fits(item, words, scene)) for item in scene.instances}
    nouns = {word for word in words if word not in SIZES and colour_of(word) is None}
    named = {
        item.id
        for item in scene.instances
        if item.source == NAMED and objects[item.id] and nouns <= set(words_of(item.label))
    }
    if nouns and named:  # a task says which thing is the sloth; others only look like one
        objects = {key: value if key in named else 0.0 for key, value in objects.items()}
    remark = f"not in the lexicon: {', '.join(unknown)}" if unknown else ""
    return objects, remark


def _fits(item: Instance, words: list[str], scene: SemanticScene) -> bool:
    names = names_of(item.label)
    colours = {colour_of(word) for word in words_of(item.label)} - {None}
    for word in words:
        colour = colour_of(word)
        if word in SIZES:
            if not _has_size(item, word, scene):
                return False
        elif colour is not None and word not in names:
            if colour not in colours:
                return False
        elif colour is None and word not in names:
            return False
    return True


def _has_size(item: Instance, word: str, scene: SemanticScene) -> bool:
    """Sizes compare a thing with the median of the scene; "open" and "flat" with its label."""
    if word in ("open", "flat"):
        return word in words_of(item.label)
    if word == "tall":
        return item.size_m[2] > 1.2 * max(item.size_m[:2])
    volumes = [float(np.prod(other.size_m)) for other in scene.instances]
    volume, middle = float(np.prod(item.size_m)), float(np.median(volumes))
    return volume < 0.8 * middle if word in ("small", "little", "tiny") else volume > 1.25 * middle


def _by_model(
    scene: SemanticScene,
    phrase: str,
    embeddings: Float[np.ndarray, "num_instances num_dims"],
    encoder: TextEncoder,
) -> dict[int, float]:
    vectors = encoder.encode([phrase, *CANONICAL])
    if embeddings.shape != (len(scene.instances), vectors.shape[1]):
        message = (
            f"the scene has {len(scene.instances)} instances and embeddings of shape "
            f"{embeddings.shape}; {encoder.source} encodes text in {vectors.shape[1]} dimensions. "
            "Make the embeddings with the same model."
        )
        raise SemanticsError(message)
    cosine = _unit(np.asarray(embeddings, dtype=np.float64)) @ _unit(vectors.astype(np.float64)).T
    # Two-way softmax of the text against each canonical phrase, the least favourable counts.
    against = LOGIT_SCALE * (cosine[:, 1:].max(axis=1) - cosine[:, 0])
    activation = 1.0 / (1.0 + np.exp(np.clip(against, -60.0, 60.0)))
    return {item.id: float(value) for item, value in zip(scene.instances, activation, strict=True)}


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12))
