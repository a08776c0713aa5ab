"""Public names of `stmc` and its packages: read by editors, type checkers, and `__init__.py`, which imports lazily."""

from . import cli as cli
from . import composing as composing
from . import data as data
from . import denoisers as denoisers
from . import diffusion as diffusion
from . import editing as editing
from . import evaluation as evaluation
from . import evaluators as evaluators
from . import formats as formats
from . import io as io
from . import model as model
from . import motion as motion
from . import run as run
from . import settings as settings
from . import text as text
from . import timeline as timeline
from . import training as training
from . import viewing as viewing
from .composing import Method, collage, find_method, guided_crops, sinc, smooth_seams, stitched
from .composing.sampling import Sampling
from .denoisers import Denoiser
from .diffusion import Noise, Schedule, ddim, ddpm, dpm_solver, guide
from .editing import (
    Change,
    FootKey,
    Oscillation,
    PelvisKey,
    TurnKey,
    WristKey,
    add_rest,
    bend_down,
    bend_path,
    change_pace,
    changed_prompt,
    changed_prompts,
    copy_arm,
    follow,
    reach,
    reverse,
    shift_pelvis,
    shift_sideways,
    step,
    turn_head,
    turn_on_spot,
    turn_trunk,
)
from .editing.constraints import Heading, Hold, Keyframe, Path, Target, read_constraints
from .editing.generate_request import GenerateRequest
from .editing.streaming import MotionStream
from .formats import read, write
from .formats.characters import Character, CharacterMotion, read_character, retarget
from .model import Model
from .motion.body import BodyPart
from .motion.body_model import Skeleton
from .motion.feet import clean_feet
from .motion.inverse_kinematics import motion_of_joints
from .motion.loops import looped
from .motion.motion import Motion
from .run import load, load_evaluator, save, suggest_parts, with_suggested_parts
from .settings.shards import Shard
from .text.vocabulary import Vocabulary
from .timeline import Prompt, Timeline, one_text, single_track
from .timeline.planning import Plan, assign, plan
from .viewing import film_strip, plot_plan, plot_timeline, render_film, render_html, view

__all__ = [
    "BodyPart",
    "Change",
    "Character",
    "CharacterMotion",
    "Denoiser",
    "FootKey",
    "GenerateRequest",
    "Heading",
    "Hold",
    "Keyframe",
    "Method",
    "Model",
    "Motion",
    "MotionStream",
    "Noise",
    "Oscillation",
    "Path",
    "PelvisKey",
    "Plan",
    "Prompt",
    "Sampling",
    "Schedule",
    "Shard",
    "Skeleton",
    "Target",
    "Timeline",
    "TurnKey",
    "Vocabulary",
    "WristKey",
    "add_rest",
    "assign",
    "bend_down",
    "bend_path",
    "change_pace",
    "changed_prompt",
    "changed_prompts",
    "clean_feet",
    "collage",
    "copy_arm",
    "ddim",
    "ddpm",
    "dpm_solver",
    "film_strip",
    "find_method",
    "follow",
    "guide",
    "guided_crops",
    "load",
    "load_evaluator",
    "looped",
    "motion_of_joints",
    "one_text",
    "plan",
    "plot_plan",
    "plot_timeline",
    "reach",
    "read",
    "read_character",
    "read_constraints",
    "render_film",
    "render_html",
    "retarget",
    "reverse",
    "save",
    "shift_pelvis",
    "shift_sideways",
    "sinc",
    "single_track",
    "smooth_seams",
    "step",
    "stitched",
    "suggest_parts",
    "turn_head",
    "turn_on_spot",
    "turn_trunk",
    "view",
    "with_suggested_parts",
    "write",
]

__version__: str
