"""Text-driven 3D human motion from a multi-track timeline (STMC, Petrovich et al., CVPRW 2024).

    model = stmc.load()
    [motion] = model.generate(stmc.Timeline.parse("walk forwards # 0 # 6 # legs"), seed=0)

Names and packages are imported when they are first used, so that `import stmc` is quick. What editors and type checkers
read instead is `__init__.pyi`.
"""

from importlib import import_module
from pkgutil import iter_modules

__version__ = "0.1.0"

_HOMES = {
    "assign": "planning", "plan": "planning", "Plan": "planning", "collage": "composing", "guided_crops": "composing",
    "sinc": "composing", "smooth_seams": "composing", "ddpm": "diffusion", "ddim": "diffusion",
    "dpm_solver": "diffusion", "guide": "diffusion", "Noise": "diffusion", "Schedule": "diffusion", "BodyPart": "body",
    "Prompt": "timeline", "Timeline": "timeline", "one_text": "timeline", "single_track": "timeline",
    "Motion": "motion", "motion_of_joints": "inverse_kinematics", "Skeleton": "body_model", "Model": "model",
    "load": "run", "save": "run", "load_evaluator": "run", "read": "export", "write": "export", "view": "viewing",
    "render_html": "viewing", "plot_timeline": "viewing", "film_strip": "viewing", "plot_plan": "viewing",
    "Sampling": "sampling", "Method": "composing", "stitched": "composing", "find_method": "composing",
    "Denoiser": "denoisers", "Shard": "shards", "suggest_parts": "run", "with_suggested_parts": "run",
    "Vocabulary": "vocabulary",
    "clean_feet": "feet", "looped": "loops", "render_film": "viewing",
    "add_rest": "editing", "bend_path": "editing", "change_pace": "editing", "follow": "editing",
    "reverse": "editing", "shift_sideways": "editing", "turn_on_spot": "editing",
    "Change": "editing", "changed_prompt": "editing", "changed_prompts": "editing", "Path": "constraints",
    "Heading": "constraints", "Keyframe": "constraints", "Target": "constraints", "Hold": "constraints",
    "read_constraints": "constraints", "FootKey": "editing", "Oscillation": "editing", "PelvisKey": "editing",
    "TurnKey": "editing", "WristKey": "editing", "bend_down": "editing", "copy_arm": "editing", "reach": "editing",
    "shift_pelvis": "editing", "step": "editing", "turn_head": "editing", "turn_trunk": "editing",
}  # fmt: skip

__all__ = sorted(_HOMES)


_ROOMS = {module.name for module in iter_modules(__path__) if not module.name.startswith("_")}


def __getattr__(name: str):
    if name in _HOMES:
        value = globals()[name] = getattr(import_module(f"stmc.{_HOMES[name]}"), name)
        return value
    if name in _ROOMS:
        return import_module(f"stmc.{name}")
    raise AttributeError(f"module 'stmc' has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, for completion; packages are there too, for those who know them."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
