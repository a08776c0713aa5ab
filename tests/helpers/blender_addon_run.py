"""Run by Blender: installs the add-on as a user does, generates onto an armature, and tells where its bones are.

python blender_addon_run.py -- REQUEST.json RESULT.json

Blender has no event loop here, so that nothing calls its timers: this script calls the add-on's own `tick` instead.
"""

import json
import sys
import time
from pathlib import Path

import bpy
from mathutils import Matrix

import addon_utils  # isort: skip  # which bpy brings along

source, target = sys.argv[sys.argv.index("--") + 1 :]
request = json.loads(Path(source).read_text())
told = {"version": bpy.app.version_string}

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_install(filepath=request["addon"], overwrite=True)
addon = addon_utils.enable("blender_addon", default_set=True, persistent=False)
preferences = bpy.context.preferences.addons["blender_addon"].preferences
preferences.address, preferences.token_file = request["address"], request["token_file"]


def run(cancel_at: str = "") -> dict:
    """Press the button and wait; what the panel says, and how long Blender was held up at most."""
    try:
        bpy.ops.stmc.generate()
    except RuntimeError as error:  # what an operator reports as an error
        return {"message": str(error), "failed": True, "longest": 0.0}
    longest, began = 0.0, time.monotonic()
    while addon.State.task is not None and time.monotonic() - began < 120:
        if cancel_at and addon.State.task.message.startswith(cancel_at):
            bpy.ops.stmc.cancel()
        before = time.perf_counter()
        addon.tick()
        longest = max(longest, time.perf_counter() - before)
        time.sleep(0.005)
    return {"message": addon.State.message, "failed": addon.State.failed, "longest": longest}


def attempt(lines=(), joints=(), cancel_at="", connect="", constrain="", **others) -> dict:
    """Another run, with other lines, bones, address or token."""
    for name in ("address", "token_file"):
        setattr(preferences, name, others.get(name, request[name]))
    scene.stmc.lines.clear()
    for line in lines or request["lines"]:
        scene.stmc.lines.add().text = line
    for joint in addon.JOINTS:
        setattr(scene.stmc.joints, joint, dict(joints).get(joint, ""))
    if constrain:
        armature.pose.bones[constrain].constraints.new("LIMIT_ROTATION")
    if connect:
        bpy.ops.object.mode_set(mode="EDIT")
        armature.data.edit_bones[connect].use_connect = True
        bpy.ops.object.mode_set(mode="OBJECT")
    before = armature.animation_data.action
    result = run(cancel_at)
    return result | {"changed": armature.animation_data.action != before}


def placed(armature, frame: int) -> dict:
    """Where the bones begin in a frame, in the world."""
    bpy.context.scene.frame_set(frame)
    return {bone.name: list(armature.matrix_world @ bone.head) for bone in armature.pose.bones}


bpy.ops.import_scene.gltf(filepath=request["character"], **request.get("importing", {}))
[armature] = [each for each in bpy.data.objects if each.type == "ARMATURE"]
for each in list(bpy.data.actions):
    bpy.data.actions.remove(each)
bpy.context.view_layer.objects.active = armature
scene = bpy.context.scene
scene.render.fps, scene.render.fps_base = request["fps"], 1.0
if "turned" in request:  # as an importer leaves it whose files have other axes and units: the same in the world
    matrix = Matrix.Rotation(request["turned"], 4, "X") @ Matrix.Scale(request["scaled"], 4)
    armature.data.transform(matrix)
    armature.matrix_world = armature.matrix_world @ matrix.inverted()
    bpy.context.view_layer.update()
for mode, bones in request.get("modes", {}).items():
    for bone in bones:
        armature.pose.bones[bone].rotation_mode = mode
for line in request["lines"]:
    scene.stmc.lines.add().text = line
for joint, bone in request.get("joints", {}).items():
    setattr(scene.stmc.joints, joint, bone)
scene.stmc.seed, scene.stmc.preview = request["seed"], True
scene.frame_set(request["start"])
told |= run()
action = armature.animation_data and armature.animation_data.action
told["action"] = action.name if action else None
told["range"] = list(action.frame_range) if action else None
told["rest"] = {bone.name: list(armature.matrix_world @ bone.head_local) for bone in armature.data.bones}
if action:
    told["heads"] = [
        placed(armature, frame) for frame in range(int(action.frame_range[0]), int(action.frame_range[1]) + 1)
    ]
told["attempts"] = [attempt(**each) for each in request.get("attempts", [])]
bpy.ops.wm.save_as_mainfile(filepath=request["saved"], compress=False)
Path(target).write_text(json.dumps(told))
addon_utils.disable("blender_addon", default_set=True)
