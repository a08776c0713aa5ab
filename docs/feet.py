"""The numbers of export.md's table of cleaned feet: python docs/feet.py CACHE... Minutes on one core."""

import sys
from statistics import fmean

import stmc
from stmc.data.cache import read_caches
from stmc.motion.kinematics import floor_penetration, foot_sliding
from stmc.motion.motion import Motion

ASKED = ("walk forwards", "run", "turn left", "wave with the right hand", "sit down", "squat", "jump forward")
SEEDS = (0, 1, 2)
SECONDS = 4.0


def main(folders: list[str]) -> None:
    """Prints how far feet slide, and what cleaning changes: of sampled motions, and of a recording of each content."""
    model, cache = stmc.load(), read_caches(folders)
    timelines = [f"{text} # 0 # {SECONDS:g}" for text in ASKED for _ in SEEDS]
    sampled = model.generate(timelines, seed=[seed for _ in ASKED for seed in SEEDS], steps=50, clean_feet=False)
    first = {clip.content: clip for clip in reversed(cache.clips) if not clip.mirrored and cache.texts[clip.texts]}
    recorded = [
        model.representation.decode(cache.features[clip.start : clip.end], cache.fps, model.skeleton)
        for clip in first.values()
    ]
    for name, motions in (("sampled", sampled), ("recorded", recorded)):
        cleaned = [stmc.clean_feet(motion) for motion in motions]
        moved = [
            float((new.joints - old.joints).norm(dim=-1).mean()) for new, old in zip(cleaned, motions, strict=True)
        ]
        print(f"{len(motions)} {name}: {_measured(motions)}")
        print(f"cleaned: {_measured(cleaned)}, {1000 * fmean(moved):.1f} mm from where it was")


def _measured(motions: list[Motion]) -> str:
    jerks = [motion.joints.diff(n=3, dim=0).norm(dim=-1) for motion in motions]
    slides = [slide for motion in motions if (slide := foot_sliding(motion)) == slide]  # a NaN is not itself
    return (
        f"sliding {1000 * fmean(slides):.1f} mm a frame of contact, "
        f"depth {1000 * fmean(map(floor_penetration, motions)):.1f} mm, "
        f"mean jerk {1000 * fmean(float(each.mean()) for each in jerks):.1f} mm/frame³, "
        f"largest {100 * fmean(float(each.max()) for each in jerks):.1f} cm/frame³"
    )


if __name__ == "__main__":
    main(sys.argv[1:] or ["cache/bandai", "cache/cmu"])
