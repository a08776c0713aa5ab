"""What `import stmc` gives, for editors and type checkers; at run time `__init__.py` imports it lazily."""

from . import arrays as arrays
from . import benchmarks as benchmarks
from . import body as body
from . import body_model as body_model
from . import bounds as bounds
from . import bvh as bvh
from . import commands as commands
from . import composing as composing
from . import conditions as conditions
from . import constraints as constraints
from . import data as data
from . import denoisers as denoisers
from . import diffusion as diffusion
from . import editing as editing
from . import evaluators as evaluators
from . import export as export
from . import feet as feet
from . import filenames as filenames
from . import files as files
from . import geometry as geometry
from . import inverse_kinematics as inverse_kinematics
from . import loops as loops
from . import metrics as metrics
from . import model as model
from . import motion as motion
from . import planning as planning
from . import published as published
from . import renamed as renamed
from . import representation as representation
from . import results as results
from . import run as run
from . import sampling as sampling
from . import settings as settings
from . import shards as shards
from . import skins as skins
from . import statistics as statistics
from . import studio as studio
from . import study as study
from . import tensors as tensors
from . import text as text
from . import timeline as timeline
from . import training as training
from . import untrusted as untrusted
from . import viewing as viewing
from . import vocabulary as vocabulary
from .body import BodyPart
from .body_model import Skeleton
from .composing import Method, collage, find_method, guided_crops, sinc, smooth_seams, stitched
from .constraints import Heading, Hold, Keyframe, Path, Target, read_constraints
from .denoisers import Denoiser
from .diffusion import Noise, Schedule, ddim, ddpm, dpm_solver, guide
from .editing import Change, changed_prompt, changed_prompts
from .export import read, write
from .feet import clean_feet
from .inverse_kinematics import motion_of_joints
from .loops import looped
from .model import Model
from .motion import Motion
from .planning import Plan, assign, plan
from .run import load, load_evaluator, save, suggest_parts, with_suggested_parts
from .sampling import Sampling
from .shards import Shard
from .timeline import Prompt, Timeline, one_text, single_track
from .viewing import film_strip, plot_plan, plot_timeline, render_film, render_html, view
from .vocabulary import Vocabulary

__all__ = [
    "BodyPart",
    "Change",
    "Denoiser",
    "Heading",
    "Hold",
    "Keyframe",
    "Method",
    "Model",
    "Motion",
    "Noise",
    "Path",
    "Plan",
    "Prompt",
    "Sampling",
    "Schedule",
    "Shard",
    "Skeleton",
    "Target",
    "Timeline",
    "Vocabulary",
    "assign",
    "changed_prompt",
    "changed_prompts",
    "clean_feet",
    "collage",
    "ddim",
    "ddpm",
    "dpm_solver",
    "film_strip",
    "find_method",
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
    "read",
    "read_constraints",
    "render_film",
    "render_html",
    "save",
    "sinc",
    "single_track",
    "smooth_seams",
    "stitched",
    "suggest_parts",
    "view",
    "with_suggested_parts",
    "write",
]

__version__: str
