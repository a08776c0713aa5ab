"""The parts of a model and of an evaluator, built from what a config says of them, with weights that fit or none.

Knows descriptions and the headers of weights; knows no folder and no numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from stmc.denoisers import Network
from stmc.diffusion import Schedule
from stmc.evaluators import Tmr
from stmc.motion.representation import Representation
from stmc.run.configs import RunError, check_plain
from stmc.run.construction import Part, construct, is_ours
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
"""The same of an evaluator."""


def build(config: Mapping[str, Any], parts: Mapping[str, Part] = PARTS, trusted: Sequence[str] = ()) -> dict[str, Any]:
    """These parts from their descriptions (`_target_` and arguments), a network with fresh weights.

    Raises `RunError` for arguments that do not fit, and for a class that is neither this library's nor of a `trusted`
    package (see `load`).
    """
    absent = [name for name in parts if name not in config]
    if absent:
        raise RunError(f"the config does not say how to build {', '.join(absent)}")
    check_plain({name: config[name] for name in parts})
    return {name: construct(config[name], name, part, trusted) for name, part in parts.items()}


def build_fitting(
    config: Mapping[str, Any],
    weights: Mapping[str, Spec],
    place: str,
    parts: Mapping[str, Part] = PARTS,
    trusted: Sequence[str] = (),
) -> dict[str, Any]:
    """As `build`, but for a network that these `weights`, which are at `place`, do not fit raises `RunError` before it
    asks for memory."""
    (name, part), *others = parts.items()
    sketch_fitting(config, weights, place, name, part, trusted)
    built = build(config, dict(others), trusted)
    check_widths(config[name], built)
    with torch.random.fork_rng(devices=[]):
        return build(config, {name: part}, trusted) | built


def sketch_fitting(
    config: Mapping[str, Any], weights: Mapping[str, Spec], place: str, name: str, part: Part, trusted: Sequence[str]
) -> torch.nn.Module:
    """The network without memory. One of somebody's own may look at numbers as it is made, and gets them.

    Raises `RunError` where these `weights`, which are at `place`, do not fit.
    """
    check_plain(config[name], name)
    meta = isinstance(config[name], Mapping) and is_ours(config[name], part)
    network = sketch(lambda: construct(config[name], name, part, trusted), len(weights), meta)
    wrong = misfit(specs_of(network.state_dict()), weights)
    if wrong:
        raise RunError(f"{place} does not fit the {name} of the config, {type(network).__name__}. {wrong}")
    return network


def check_widths(described: Mapping[str, Any], parts: Mapping[str, Any]) -> None:
    """Raises `RunError` where a network is `described` with other widths than the built `parts` have."""
    for argument, part in (("features", "representation"), ("text_width", "text_encoder")):
        if argument in described and described[argument] != parts[part].width:
            raise RunError(f"the network has {argument} {described[argument]}, the {part} {parts[part].width}")
