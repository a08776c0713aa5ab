"""Motions of timelines on the selected armature, sampled by a `stmc studio` on this machine.

Edit > Preferences > Add-ons > Install from Disk; then the tab "stmc" in the sidebar (N) of the 3D view. Nothing but the
joints of the armature at rest and the timeline is sent, and only to this machine. Blender 3.4 or newer.
"""

import json
import math
import textwrap
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import bpy
from bpy.props import BoolProperty, CollectionProperty, IntProperty, PointerProperty, StringProperty
from mathutils import Matrix, Quaternion, Vector

bl_info = {
    "name": "stmc: motions of timelines",
    "author": "The stmc authors",
    "version": (0, 1, 0),
    "blender": (3, 4, 0),
    "location": "3D View > Sidebar > stmc",
    "description": "Sample a timeline with stmc studio, and bring the motion onto the selected armature",
    "category": "Animation",
}

SIDES = ("left", "right")
_PAIRS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
JOINTS = ("pelvis", "head", *(f"{side}_{joint}" for joint in _PAIRS for side in SIDES))
"""The joints that an armature is asked for; `foot` is where the toes begin."""

SILENCE = 600
"""Seconds without a word from the studio after which it counts as gone; other jobs may run first."""

PAUSE, SHARE = 0.1, 0.03
"""Seconds between two looks at the task, and seconds that one may take."""

LEAST_FPS, MOST_FPS = 1, 240
LETTER = 7
"""Pixels of a letter of a message, about."""


# ---- the studio ------------------------------------------------------------------------------------------------------


class StudioError(Exception):
    """A problem that the user can solve; the message says how."""


class Studio:
    """A running studio on this machine, and its token."""

    def __init__(self, address: str, token_file: str) -> None:
        parts = urlsplit(address.strip())
        if parts.scheme != "http" or parts.hostname not in ("127.0.0.1", "localhost", "::1"):
            raise StudioError("The address must be one of this machine, such as http://127.0.0.1:8686")
        try:
            token = Path(token_file).expanduser().read_text().strip()
        except (OSError, ValueError):
            raise StudioError(
                f"There is no token in {token_file}: start `stmc studio`, which says where it is"
            ) from None
        self.address, self.headers = address.strip().rstrip("/"), {"Authorization": f"Bearer {token}"}
        self.opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # no proxy gets the token

    def ask(self, method: str, path: str, data: object = None) -> dict:
        """Return the JSON answer to a request."""
        with self.open(method, path, data) as answer:
            return json.load(answer)

    def open(self, method: str, path: str, data: object = None):
        """Return the open answer to a request. Raise `StudioError` for a refusal, and where nothing answers."""
        body = None if data is None else json.dumps(data).encode()
        headers = self.headers | {"Content-Type": "application/json"}
        try:
            request = urllib.request.Request(self.address + path, body, headers, method=method)
            return self.opener.open(request, timeout=SILENCE)
        except urllib.error.HTTPError as error:
            raise StudioError(_refusal(error)) from None
        except (OSError, ValueError):
            raise StudioError(f"No studio answers at {self.address}: start `stmc studio`") from None

    def events(self, job: str):
        """Yield the events of a job: their names and their data."""
        with self.open("GET", f"/api/jobs/{job}/events") as stream:
            name = ""
            for line in stream:
                key, _, value = line.decode().rstrip("\n").partition(": ")
                if key == "event":
                    name = value
                elif key == "data":
                    yield name, json.loads(value)


def _refusal(error: urllib.error.HTTPError) -> str:
    try:
        sentence = json.load(error)["error"]
    except (ValueError, KeyError, TypeError):
        return f"The server answered {error.code}: is it a studio?"
    return sentence[:1].upper() + sentence[1:]


class Task:
    """A request to the studio in a thread of its own, which touches nothing of Blender.

    `keys` is the motion of the skeleton, once it is there; `error` a sentence, if it never will be.
    """

    def __init__(self, studio: Studio, job: dict, skeleton: dict, joint_map: dict, fps: float, connected: set) -> None:
        self.studio, self.job, self.fps, self.connected = studio, job, fps, connected
        self.rig = {"skeleton": skeleton, "joint_map": joint_map}
        self.message, self.progress, self.error, self.keys = "Finding the joints", 0.0, "", None
        self.cancelled, self.name = threading.Event(), None
        self.thread = threading.Thread(target=self._run, name="stmc", daemon=True)
        self.thread.start()

    @property
    def ended(self) -> bool:
        """Whether the thread has nothing left to do, or is not waited for."""
        return self.cancelled.is_set() or self.keys is not None or bool(self.error)

    def cancel(self) -> None:
        """Cancel the job, without waiting for the studio."""
        self.cancelled.set()
        threading.Thread(target=self._forget, name="stmc cancel", daemon=True).start()

    def _run(self) -> None:
        try:
            self._check_travel(self.studio.ask("POST", "/api/map", self.rig)["joint_map"])
            motion = self._sampled()
            if not self.cancelled.is_set():
                self.message = "Bringing the motion onto the armature"
                request = self.rig | {"motion": motion, "fps": self.fps}
                self.keys = self.studio.ask("POST", "/api/retarget", request)
        except StudioError as error:
            self.error = str(error)
        except Exception as error:  # the connection broke, or an answer is none of a studio
            self.error = f"The connection to the studio broke ({type(error).__name__}): see its terminal"

    def _check_travel(self, joint_map: dict) -> None:
        pelvis = joint_map["pelvis"]
        if pelvis in self.connected:
            raise StudioError(f"The bone {pelvis} cannot travel, since it is connected to its parent: disconnect it")

    def _sampled(self) -> str:
        """Sample the timeline, and return the motion's name."""
        self.name = self.studio.ask("POST", "/api/jobs", self.job)["job"]
        if self.cancelled.is_set():
            self._forget()
        motion = ""
        for event, data in self.studio.events(self.name):
            if event == "progress":
                self.message = data["stage"].capitalize()
                self.progress = data["step"] / data["steps"] if data["steps"] else 0.0
            elif event == "motion":
                motion = data["motion"]["id"]
            elif event == "failed":
                raise StudioError(data["error"][:1].upper() + data["error"][1:])
            elif event == "cancelled" and not self.cancelled.is_set():
                raise StudioError("The studio has cancelled the job")
        return motion

    def _forget(self) -> None:
        try:
            if self.name:
                self.studio.ask("DELETE", f"/api/jobs/{self.name}")
        except StudioError:
            pass  # the job ends with its studio


# ---- armatures -------------------------------------------------------------------------------------------------------


def upright(armature) -> Quaternion:
    """Return the quarter or half turn from an armature's own axes to z up: which axis points up, the scene says."""
    up = armature.matrix_world.to_3x3().inverted_safe() @ Vector((0, 0, 1))
    largest = max(range(3), key=lambda axis: abs(up[axis]))
    axis = Vector([math.copysign(1.0, up[largest]) if each == largest else 0.0 for each in range(3)])
    return axis.rotation_difference(Vector((0, 0, 1)))


def skeleton_of(armature) -> dict:
    """Return the rest pose of an armature for the studio, in the armature's own unit."""
    turn = upright(armature)
    joints = [
        {"name": bone.name, "parent": bone.parent and bone.parent.name, "place": list(turn @ bone.head_local)}
        for bone in armature.data.bones
    ]
    return {"up": "z", "joints": joints}


def animate(armature, keys: dict, name: str, start: int):
    """Give an armature a new action with these keys; its former action stays in the file.

    A generator that yields between frames, and writes only at its end. The bones above those that move are put at rest.
    """
    bones = [bone for bone in armature.data.bones if _carries(bone, keys["turns"])]  # parents before children
    axes = upright(armature)
    curves = {bone.name: [] for bone in bones}
    for frame in range(keys["frames"]):
        pose = {}
        for bone in bones:
            pose[bone.name], basis = _posed(bone, keys, frame, pose, axes)
            curves[bone.name].append(basis)
        yield
    action = _new_action(armature, name)
    for bone in bones:
        pose_bone = armature.pose.bones[bone.name]
        pose_bone.matrix_basis = Matrix.Identity(4)  # a former pose may have moved or scaled it
        if bone.name not in keys["turns"]:
            continue
        path, values = _rotations(pose_bone, curves[bone.name])
        _write(armature, action, pose_bone, path, values, start)
        if bone.name == keys["travelling"]:
            _write(
                armature, action, pose_bone, "location", [list(each.translation) for each in curves[bone.name]], start
            )
        yield


def _carries(bone, turns: dict) -> bool:
    """Return whether a bone moves, or one below it."""
    return bone.name in turns or any(child.name in turns for child in bone.children_recursive)


def _posed(bone, keys: dict, frame: int, pose: dict, axes: Quaternion):
    """Return the matrix of a bone in a frame, in the armature's axes, and the channels that bring it there."""
    above, rest = bone.parent, bone.matrix_local
    parent = {"parent_matrix": pose[above.name], "parent_matrix_local": above.matrix_local} if above else {}
    matrix = bone.convert_local_to_pose(Matrix.Identity(4), rest, **parent)
    if bone.name not in keys["turns"]:
        return matrix, Matrix.Identity(4)
    travels = bone.name == keys["travelling"]
    place = axes.inverted() @ Vector(keys["places"][frame]) if travels else matrix.translation
    turn = axes.inverted() @ Quaternion(keys["turns"][bone.name][frame]) @ axes
    matrix = Matrix.LocRotScale(place, turn @ rest.to_quaternion(), None)
    return matrix, bone.convert_local_to_pose(matrix, rest, invert=True, **parent)


def _rotations(pose_bone, bases: list) -> tuple:
    """Return the rotation channel that a bone uses, and its values, without jumps."""
    values, before = [], None
    for basis in bases:
        turn = basis.to_quaternion()
        if before is not None:
            turn.make_compatible(before)
        before = turn
        values.append(turn)
    mode = pose_bone.rotation_mode
    if mode == "QUATERNION":
        return "rotation_quaternion", [list(each) for each in values]
    if mode == "AXIS_ANGLE":
        return "rotation_axis_angle", [[each.angle, *each.axis] for each in values]
    angles = []
    for turn in values:
        angles.append(turn.to_euler(mode, angles[-1]) if angles else turn.to_euler(mode))
    return "rotation_euler", [list(each) for each in angles]


def _new_action(armature, name: str):
    data = armature.animation_data or armature.animation_data_create()
    if data.action:
        data.action.use_fake_user = True  # kept when the file is saved
    action = bpy.data.actions.new(name)
    data.action = action
    if hasattr(action, "slots"):  # Blender 4.4
        data.action_slot = action.slots.new(id_type="OBJECT", name=armature.name)
    return action


def _write(armature, action, pose_bone, channel: str, values: list, start: int) -> None:
    """Write a curve for each number of a channel: a key a frame, straight lines between them."""
    path = f'pose.bones["{bpy.utils.escape_identifier(pose_bone.name)}"].{channel}'
    straight = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items["LINEAR"].value
    for index in range(len(values[0])):
        if hasattr(action, "fcurve_ensure_for_datablock"):  # Blender 4.4
            curve = action.fcurve_ensure_for_datablock(armature, path, index=index, group_name=pose_bone.name)
        else:
            curve = action.fcurves.new(path, index=index, action_group=pose_bone.name)
        points = [number for frame, value in enumerate(values) for number in (start + frame, value[index])]
        curve.keyframe_points.add(len(values))
        curve.keyframe_points.foreach_set("co", points)
        curve.keyframe_points.foreach_set("interpolation", [straight] * len(values))
        curve.update()


# ---- one task at a time ----------------------------------------------------------------------------------------------


class State:
    """The task that runs, and the last message. `work` is the generator that writes the keys."""

    task: Task | None = None
    work = None
    armature, title, start = "", "", 1
    message, failed = "", False


def tick():
    """Look at the task, and go on for a moment; return the seconds until the next look, None at the end."""
    task = State.task
    if task is None:
        return None
    try:
        if task.cancelled.is_set():
            return _end("Cancelled")
        if task.error:
            return _end(task.error, failed=True)
        if task.keys is not None:
            return _go_on(task)
    except Exception as error:
        return _end(f"The keys could not be written ({error})", failed=True)
    _redraw()
    return PAUSE


def _go_on(task: Task):
    armature = bpy.data.objects.get(State.armature)
    if armature is None or armature.type != "ARMATURE":
        return _end(f"The armature {State.armature} is gone", failed=True)
    if State.work is None:
        missing = [name for name in task.keys["turns"] if name not in armature.pose.bones]
        if missing:
            return _end(f"The bone {missing[0]} is gone; generate again", failed=True)
        State.work = animate(armature, task.keys, State.title, State.start)
    until = time.perf_counter() + SHARE
    while time.perf_counter() < until:
        if next(State.work, "done") == "done":
            return _finish(armature, task.keys)
    return 0.01


def _finish(armature, keys: dict):
    scene = bpy.context.scene
    scene.frame_end = max(scene.frame_end, State.start + keys["frames"] - 1)
    held = [name for name in keys["turns"] if any(not each.mute for each in armature.pose.bones[name].constraints)]
    done = f"{keys['frames']} frames on {armature.name}; joints by {keys['found_by']}"
    if held:
        others = f" and {len(held) - 1} more bones" if held[1:] else ""
        done += f". Constraints may hold {held[0]}{others}: mute them"
    if not bpy.app.background:
        bpy.ops.ed.undo_push(message="stmc: generate")
    return _end(done)


def _end(message: str, failed: bool = False) -> None:
    State.task, State.work, State.message, State.failed = None, None, message, failed
    _redraw()


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


# ---- the panel -------------------------------------------------------------------------------------------------------


class STMC_Preferences(bpy.types.AddonPreferences):
    """Where the studio is. They belong to the user: no .blend file holds or sets them."""

    bl_idname = __name__
    address: StringProperty(
        name="Address", default="http://127.0.0.1:8686", description="Of the studio, on this machine"
    )
    token_file: StringProperty(
        name="Token file",
        default="~/.stmc/studio/api_token",
        subtype="FILE_PATH",
        description="As `stmc studio` prints it",
    )

    def draw(self, context) -> None:
        """Show both fields."""
        self.layout.prop(self, "address")
        self.layout.prop(self, "token_file")


class STMC_Line(bpy.types.PropertyGroup):
    """A prompt."""

    text: StringProperty(name="Prompt", description="text # start # end # body part (seconds; parts may be left out)")


STMC_Joints = type(
    "STMC_Joints",
    (bpy.types.PropertyGroup,),
    {"__annotations__": {joint: StringProperty(name=joint.replace("_", " ").capitalize()) for joint in JOINTS}},
)


class STMC_Settings(bpy.types.PropertyGroup):
    """The timeline of a scene."""

    lines: CollectionProperty(type=STMC_Line)
    joints: PointerProperty(type=STMC_Joints)
    seed: IntProperty(name="Seed", min=0, description="Another seed gives another motion")
    preview: BoolProperty(name="Preview", description="Few steps of denoising: faster and rougher")


def armature_of(context):
    """Return the armature that is selected, or that moves what is selected."""
    active = context.object
    if active is None:
        return None
    return active if active.type == "ARMATURE" else active.find_armature()


class STMC_OT_generate(bpy.types.Operator):
    """Sample the timeline, and bring the motion onto the armature from the current frame on"""

    bl_idname, bl_label = "stmc.generate", "Generate onto selected armature"

    @classmethod
    def poll(cls, context) -> bool:
        """Return whether an armature is selected, in a mode in which it can be posed, and nothing is running."""
        return State.task is None and context.mode in ("OBJECT", "POSE") and armature_of(context) is not None

    def execute(self, context):
        """Start the task, and look at it until it has ended."""
        settings, scene, armature = context.scene.stmc, context.scene, armature_of(context)
        lines = [line.text for line in settings.lines if line.text.strip()]
        preferences = context.preferences.addons[__name__].preferences
        fps = scene.render.fps / scene.render.fps_base
        try:
            if not lines:
                raise StudioError("Write a prompt first, such as: walk forwards # 0 # 4")
            if not LEAST_FPS <= fps <= MOST_FPS:
                raise StudioError(f"The scene has {fps:g} frames per second; {LEAST_FPS} to {MOST_FPS} are possible")
            studio = Studio(preferences.address, preferences.token_file)
        except StudioError as error:
            _end(str(error), failed=True)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        steps = "preview" if settings.preview else "full"
        job = {"timeline": "\n".join(lines), "seeds": [settings.seed], "steps": steps}
        joint_map = {joint: getattr(settings.joints, joint) for joint in JOINTS if getattr(settings.joints, joint)}
        connected = {bone.name for bone in armature.data.bones if bone.use_connect}
        State.armature, State.title, State.start = (
            armature.name,
            f"stmc: {lines[0].split('#')[0].strip()}",
            scene.frame_current,
        )
        State.message, State.work = "", None
        State.task = Task(studio, job, skeleton_of(armature), joint_map, fps, connected)
        bpy.app.timers.register(tick, first_interval=PAUSE, persistent=True)
        return {"FINISHED"}


class STMC_OT_cancel(bpy.types.Operator):
    """Cancel; the armature stays as it is"""

    bl_idname, bl_label = "stmc.cancel", "Cancel"

    def execute(self, context):
        """Cancel the task, if one runs."""
        if State.task is not None:
            State.task.cancel()
        return {"FINISHED"}


class STMC_OT_line(bpy.types.Operator):
    """Add or remove a prompt"""

    bl_idname, bl_label, bl_options = "stmc.line", "Prompt", {"UNDO", "INTERNAL"}
    index: IntProperty(default=-1, description="The prompt to remove; -1: add one")

    def execute(self, context):
        """Change the list."""
        lines = context.scene.stmc.lines
        if 0 <= self.index < len(lines):
            lines.remove(self.index)
        else:
            end = max((_end_of(line.text) for line in lines), default=0.0)
            lines.add().text = f"walk forwards # {end:g} # {end + 4:g}"
        return {"FINISHED"}


def _end_of(line: str) -> float:
    """Return the end of a prompt in seconds, 0 if it is none."""
    try:
        end = float(line.split("#")[2])
    except (IndexError, ValueError):
        return 0.0
    return end if math.isfinite(end) else 0.0


class STMC_PT_panel(bpy.types.Panel):
    """The timeline, the studio, and what is going on."""

    bl_label, bl_category, bl_space_type, bl_region_type = "Motion of a timeline", "stmc", "VIEW_3D", "UI"

    def draw(self, context) -> None:
        """Show the panel."""
        layout, settings = self.layout, context.scene.stmc
        preferences = context.preferences.addons[__name__].preferences
        layout.prop(preferences, "address", text="", icon="URL")
        layout.prop(preferences, "token_file", text="", icon="LOCKED")
        box = layout.box()
        for index, line in enumerate(settings.lines):
            row = box.row(align=True)
            row.prop(line, "text", text="")
            row.operator("stmc.line", text="", icon="X").index = index
        box.operator("stmc.line", text="Add a prompt", icon="ADD").index = -1
        row = layout.row()
        row.prop(settings, "seed")
        row.prop(settings, "preview")
        task, armature = State.task, armature_of(context)
        if task is not None:
            text = f"{task.message}: {task.progress:.0%}" if task.progress else task.message
            if hasattr(layout, "progress"):  # Blender 4.0
                layout.progress(factor=task.progress, text=text)
            else:
                layout.label(text=text)
            layout.operator("stmc.cancel", icon="CANCEL")
        else:
            layout.operator(
                "stmc.generate", text=f"Generate onto {armature.name}" if armature else "Select an armature"
            )
        letters = max(16, int((context.region.width - 60) / LETTER / context.preferences.system.ui_scale))
        for number, part in enumerate(textwrap.wrap(State.message, letters)):
            layout.label(text=part, icon="NONE" if number else "ERROR" if State.failed else "INFO")


class STMC_PT_joints(bpy.types.Panel):
    """Bones that the studio does not find by their names or by the shape of the armature."""

    bl_label, bl_category, bl_space_type, bl_region_type = "Bones", "stmc", "VIEW_3D", "UI"
    bl_parent_id, bl_options = "STMC_PT_panel", {"DEFAULT_CLOSED"}

    def draw(self, context) -> None:
        """Show a field for each joint."""
        self.layout.label(text="Empty: the studio finds the bone")
        armature = armature_of(context)
        if armature:
            for joint in JOINTS:
                self.layout.prop_search(context.scene.stmc.joints, joint, armature.data, "bones")


CLASSES = (
    STMC_Preferences, STMC_Line, STMC_Joints, STMC_Settings, STMC_OT_generate, STMC_OT_cancel, STMC_OT_line,
    STMC_PT_panel, STMC_PT_joints,
)  # fmt: skip


def register() -> None:
    """Add the panel to Blender."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.stmc = PointerProperty(type=STMC_Settings)


def unregister() -> None:
    """Remove the panel, and cancel what runs."""
    if State.task is not None:
        State.task.cancel()
        _end("")
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    del bpy.types.Scene.stmc
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
