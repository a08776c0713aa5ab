"""The parts of a model and of an evaluator, built from the descriptions in a config, with weights that fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from stmc.denoisers import Network
from stmc.diffusion import Schedule
from stmc.evaluators import Tmr
from stmc.motion.representation import Representation
from stmc.run.configs import RunError, check_plain
from stmc.run.construction import Part, construct, is_from_library
from stmc.run.weights import Spec, misfit, sketch, specs_of
from stmc.text import TextEncoder

PARTS = {
    "denoiser": Part("stmc.denoisers", Network),
    "schedule": Part("stmc.diffusion", Schedule),
    "text_encoder": Part("stmc.text", TextEncoder),
    "representation": Part("stmc.motion.representation", Representation),
}
"""The parts of a model that a config describes; the first is the network with the weights."""
EVALUATOR_PARTS = {
    "network": Part("stmc.evaluators", Tmr),
    "text_encoder": PARTS["text_encoder"],
    "representation": PARTS["representation"],
}
"""The parts of an evaluator that a config describes; the first is the network with the weights."""


def build(config: Mapping[str, Any], parts: Mapping[str, Part] = PARTS, trusted: Sequence[str] = ()) -> dict[str, Any]:
    """Build parts from their descriptions (`_target_` and arguments); a network has fresh weights.

    Args:
        config: Description of each part.
        parts: Legal values of each part.
        trusted: Trusted packages; see `load`.

    Raises:
        RunError: If arguments do not fit, or a class is neither of this library nor of a trusted package.
    """
    absent = [name for name in parts if name not in config]
    if absent:
        raise RunError(f"the config does not describe {', '.join(absent)}")
    check_plain({name: config[name] for name in parts})
    return {name: construct(config[name], name, part, trusted) for name, part in parts.items()}


def build_fitting(
    config: Mapping[str, Any],
    weights: Mapping[str, Spec],
    place: str,
    parts: Mapping[str, Part] = PARTS,
    trusted: Sequence[str] = (),
) -> dict[str, Any]:
    """Build parts, and check before allocating memory that the weights fit the network.

    Args:
        config: Description of each part.
        weights: Shapes and dtypes of the weights.
        place: File of the weights, for messages.
        parts: Legal values of each part.
        trusted: Trusted packages; see `load`.

    Raises:
        RunError: As `build`, and if the weights do not fit.
    """
    (name, part), *others = parts.items()
    sketch_fitting(config, weights, place, name, part, trusted)
    built = build(config, dict(others), trusted)
    check_widths(config[name], built)
    with torch.random.fork_rng(devices=[]):
        return build(config, {name: part}, trusted) | built


def sketch_fitting(
    config: Mapping[str, Any], weights: Mapping[str, Spec], place: str, name: str, part: Part, trusted: Sequence[str]
) -> torch.nn.Module:
    """Build the network without memory, and check that the weights fit.

    A network of a trusted package may read numbers while it is built, and is built in memory.

    Args:
        config: Description of each part.
        weights: Shapes and dtypes of the weights.
        place: File of the weights, for messages.
        name: Name of the network's part.
        part: Legal values of the part.
        trusted: Trusted packages; see `load`.

    Raises:
        RunError: If the network cannot be built, or the weights do not fit.
    """
    check_plain(config[name], name)
    meta = isinstance(config[name], Mapping) and is_from_library(config[name], part)
    network = sketch(lambda: construct(config[name], name, part, trusted), len(weights), meta)
    wrong = misfit(specs_of(network.state_dict()), weights)
    if wrong:
        raise RunError(f"{place} does not fit the {name} of the config, {type(network).__name__}. {wrong}")
    return network


def check_widths(described: Mapping[str, Any], parts: Mapping[str, Any]) -> None:
    """Raise `RunError` if the described widths of a network differ from those of the built `parts`."""
    for argument, part in (("features", "representation"), ("text_width", "text_encoder")):
        if argument in described and described[argument] != parts[part].width:
            raise RunError(
                f"the network has {argument} {described[argument]}, but the {part} has width {parts[part].width}"
            )
