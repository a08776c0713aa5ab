"""The numbers and pictures of editing.md: python docs/editing.py [edits|constraints|motions|reaches] [steps]. It takes
minutes."""

import math
import sys
from pathlib import Path
from statistics import fmean

import torch

import stmc
from stmc.editing import Kept
from stmc.editing.conditions import clean_motions
from stmc.editing.constraints import Pose
from stmc.evaluation.metrics.action_measures import lifts, mean_speed, waves
from stmc.motion.geometry import rotation_z
from stmc.motion.kinematics import foot_sliding, turn
from stmc.motion.motion import Motion

PICTURES = Path(__file__).parent / "assets"
SEEDS = (0, 1, 2)
WALK = "walk forwards # 0 # 6 # legs\n"
EDITS = (
    (
        "an arm's prompt",
        WALK + "raise the right arm # 2 # 5 # right arm",
        WALK + "wave with the right hand # 2 # 5 # right arm",
        None,
        lambda motion: waves(motion.trimmed(35, 105), ["right"]),
    ),
    (
        "a later prompt",
        "walk forwards # 0 # 3 # legs\nwalk and turn left # 3 # 6 # legs",
        "walk forwards # 0 # 3 # legs\nwalk and turn right # 3 # 6 # legs",
        None,
        lambda motion: turn(motion.trimmed(60, 120)) < -math.radians(40),
    ),
    (
        "the middle, whole body",
        "walk forwards # 0 # 7 # legs",
        "walk forwards # 0 # 2 # legs\nraise both arms # 2 # 5 # left arm # right arm # legs # head # spine\n"
        "walk forwards # 5 # 7 # legs",
        [stmc.Change(2, 5)],
        lambda motion: lifts(motion.trimmed(40, 100), ["left", "right"]),
    ),
    (
        "a motion goes on",
        "walk forwards # 0 # 3 # legs",
        "walk forwards # 0 # 3 # legs\nrun # 3 # 6 # legs",
        [],
        lambda motion: mean_speed(motion.trimmed(65, 120)) > 1.5,
    ),
    (
        "an arm gets a prompt",
        "walk forwards # 0 # 5 # legs",
        "walk forwards # 0 # 5 # legs\nwave with the left hand # 1 # 4 # left arm",
        [stmc.Change(1, 4, ["left arm"])],
        lambda motion: waves(motion.trimmed(15, 85), ["left"]),
    ),
)
WALK_AND_RAISE = WALK + "raise the right arm # 2 # 5 # right arm"
PATH = stmc.Path([(0, 0), (0, -3), (3, -3)])
FOOT, HAND = stmc.Target("left_foot", (0.1, -2.1, 0.15), 2), stmc.Target("right_hand", (1.5, -3.45, 1.3), 4.5)
HEADING, HELD = stmc.Heading(1.57, 4.5), stmc.Hold("left_hand", 3.5, 4)


def constraints_on(pose: Motion) -> dict[str, list]:
    """Each kind alone, then together; keyframes have the `pose`."""
    return {
        "path": [PATH],
        "heading": [stmc.Heading(1.57, 3, 6)],
        "keyframe": [stmc.Keyframe(pose, 3)],
        "hand": [stmc.Target("right_hand", (-0.3, -2.2, 1.4), 3)],
        "foot": [FOOT],
        "hold": [stmc.Hold("left_hand", 3.5, 4.5)],
        "path + keyframe": [PATH, stmc.Keyframe(pose, 3)],
        "path + hand": [PATH, HAND],
        "path + foot": [PATH, FOOT],
        "path + hold": [PATH, HELD],
        "path + heading": [PATH, HEADING],
        "keyframe + hand": [stmc.Keyframe(pose, 3), stmc.Target("right_hand", (-0.3, -2.2, 1.4), 4)],
        "path + keyframe + hand + foot": [PATH, stmc.Keyframe(pose, 3.2), HAND, FOOT],
        "all": [PATH, stmc.Keyframe(pose, 3), HAND, FOOT, HEADING, stmc.Hold("left_hand", 5.2, 5.7)],
    }


def edits(model: stmc.Model, steps: int) -> None:
    for number, (name, before, after, changes, shown) in enumerate(EDITS):
        old = model.generate([before] * 3, seed=SEEDS, steps=steps, clean_feet=False)
        if changes is None:
            changes = stmc.changed_prompts(stmc.Timeline.parse(before), stmc.Timeline.parse(after))
        new = model.generate([after] * 3, seed=[10, 11, 12], keep=old, change=changes, steps=steps, clean_feet=False)
        again = model.generate([after] * 3, seed=SEEDS, steps=steps, clean_feet=False)
        for seed, first, second, same in zip(SEEDS, old, new, again, strict=True):
            told = f"{name}, seed {seed}: {_kept(first, second, changes)}, new text shown: {shown(second)}"
            sys.stdout.write(f"{told}; same seed alone: shown {shown(same)}, {_legs(first, same)}\n")
        for state, motion, timeline in (("before", old[0], before), ("after", new[0], after)):
            strip = stmc.film_strip(motion, stmc.Timeline.parse(timeline), frames=10)
            strip.savefig(PICTURES / f"edit_{number}_{state}.png", dpi=55)


def _kept(old: Motion, new: Motion, changes) -> str:
    """How equal what is kept is, and how smooth its borders are beside everything else."""
    weights = Kept.all_but(list(changes), old, new.frames).weights
    whole, frames = (weights == 1).all(dim=1), min(old.frames, new.frames)
    first, last = int((~whole).nonzero()[0]), int((~whole).nonzero()[-1]) + 1
    before = float((new.joints[:first] - old.joints[:first]).abs().max()) if first else 0.0
    after = float((_from(new, last, frames) - _from(old, last, frames)).abs().max()) if last < frames else 0.0
    edge = ((weights > 0) & (weights < 1)).any(dim=1)
    for frame in (weights == 1).int().diff(dim=0).ne(0).any(dim=1).nonzero()[:, 0].tolist():
        edge[max(0, frame - 3) : frame + 5] = True
    told = [f"kept to {max(before, after):.1e} m"]
    for what, order in (("step", 1), ("jerk", 3)):
        values = new.joints.diff(n=order, dim=0).norm(dim=-1).amax(dim=1)
        there = edge[order - 1 : order - 1 + len(values)]
        told.append(f"largest {what} at borders {values[there].max():.3f}, elsewhere {values[~there].max():.3f}")
    return ", ".join(told)


def _from(motion: Motion, frame: int, end: int) -> torch.Tensor:
    """Joints from a frame on, as seen from where the body stands and looks there."""
    motion = motion.to(dtype=torch.float64)
    return (motion.joints[frame:end] - motion.translation[frame]) @ rotation_z(-motion.heading[frame]).mT


def _legs(old: Motion, new: Motion) -> str:
    frames = min(old.frames, new.frames)
    legs = [joint for joint, name in enumerate(stmc.motion.body.JOINTS) if name in stmc.BodyPart.LEGS.joints]
    moved = (new.joints[:frames] - old.joints[:frames])[:, legs].norm(dim=-1).mean()
    return f"legs moved {100 * float(moved):.1f} cm"


def constraints(model: stmc.Model, steps: int) -> None:
    """Largest errors, and what they cost, as sampled and with clean feet: of each motion, and the means of three."""
    asked = {"seed": SEEDS, "steps": steps, "sampler": "ddim", "clean_feet": False}
    [bow] = model.generate("bow # 0 # 3", seed=0, steps=steps, clean_feet=False)
    deepest = int(bow.joints[:, stmc.motion.body.JOINTS.index("head"), 2].argmin())
    free = model.generate([WALK_AND_RAISE] * 3, **asked)
    sys.stdout.write(f"nothing demanded: {_cost(free)}; clean {_cost(clean_motions(free, [], []))}\n")
    for name, demands in constraints_on(bow.trimmed(deepest, deepest + 1)).items():
        met = model.generate([WALK_AND_RAISE] * 3, constraints=demands, **asked)
        clean = clean_motions(met, [], demands)
        errors = [", ".join(_errors(demands, motion) for motion in motions) for motions in (free, met, clean)]
        sys.stdout.write(f"{name}: {errors[0]} → {errors[1]}, clean {errors[2]}; {_cost(met)}; clean {_cost(clean)}\n")
        strip = stmc.film_strip(clean[0], stmc.Timeline.parse(WALK_AND_RAISE), frames=10)
        strip.savefig(PICTURES / f"constraint_{name.replace(' + ', '_')}.png", dpi=55)


def motions(model: stmc.Model, steps: int) -> None:
    """A walk that becomes a walk in a circle."""
    [walk] = model.generate("walk forwards # 0 # 7 # legs", seed=0, steps=steps)
    circle = stmc.clean_feet(stmc.bend_path(walk, angle=2 * math.pi))
    for name, motion in (("walk", walk), ("circle", circle)):
        away = float((motion.translation[-1] - motion.translation[0])[:2].norm())
        sys.stdout.write(f"{name}: ends {away:.2f} m away, slides {100 * foot_sliding(motion):.2f} cm a frame\n")
    stmc.film_strip(circle, frames=10).savefig(PICTURES / "edited_circle.png", dpi=55)


def _errors(demands: list, motion: Motion) -> str:
    """The largest of each, in centimetres (a heading's: in degrees)."""
    scales = [100 if each.unit == "m" else math.degrees(1) for each in demands]
    return "/".join(
        f"{scale * float(each.errors(Pose.of(motion)).max()):.1f}" for scale, each in zip(scales, demands, strict=True)
    )


def _cost(motions: list[Motion]) -> str:
    jerks = [motion.joints.diff(n=3, dim=0).norm(dim=-1) for motion in motions]
    mean, most = fmean(float(each.mean()) for each in jerks), fmean(float(each.max()) for each in jerks)
    return f"jerk {mean:.4f}, at most {most:.3f} m/frame³, sliding {100 * fmean(map(foot_sliding, motions)):.2f} cm"


def reaches(model: stmc.Model, steps: int) -> None:
    """The picture of a gesture on a walk."""
    [motion] = model.generate("walk forwards # 0 # 5 # legs", seed=0, steps=steps)
    ear = stmc.WristKey(1.5, 0.7, (0.17, 0.02, 0.06), frame="head", pole=(0.6, -1, 0.3), shrug=0.1)
    phoned = stmc.turn_head(motion, [stmc.TurnKey(1.5, 0.6, roll=0.15), stmc.TurnKey(4.5, 0.6)])
    phoned = stmc.reach(phoned, "left", [ear, stmc.WristKey(4.6, 0.7)], tremor=0.001, seed=0)
    stmc.film_strip(phoned, frames=8).savefig(PICTURES / "edit_reach.png", dpi=70)


if __name__ == "__main__":
    wanted, steps = (sys.argv[1:] + ["all", "25"][len(sys.argv) - 1 :])[:2]
    bundled = stmc.load()
    if wanted in ("all", "edits"):
        edits(bundled, int(steps))
    if wanted in ("all", "constraints"):
        constraints(bundled, int(steps))
    if wanted in ("all", "reaches"):
        reaches(bundled, int(steps))
    if wanted in ("all", "motions"):
        motions(bundled, int(steps))
