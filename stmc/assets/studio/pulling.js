// A pose that a hand pulls: limbs bend so that their end is somewhere else, until the motion that is sampled does so.
// Knows bones in the world (metres); a sketch for the eye, while `Target` in stmc/editing/constraints holds exactly.

import { Quaternion, Vector3 } from "./vendor/three.module.min.js";

const LIMBS = { hand: ["shoulder", "elbow", ["hand", "wrist"]], foot: ["hip", "knee", ["foot", "ankle"]] };
const ROUNDS = 8; // over the trunk's bones
const SHARE = 0.35; // of what is left, for each of the trunk's bones
const PALM = 0.3; // of the forearm's length, from the wrist to the middle of the hand
const STRETCHED = 0.999; // of a limb's length

const placeOf = (bone) => bone.getWorldPosition(new Vector3());

// Turns a bone and all that hangs from it, in the world.
function turn(bone, by) {
  const above = bone.parent.getWorldQuaternion(new Quaternion());
  bone.quaternion.premultiply(above.clone().invert().multiply(by).multiply(above));
  bone.updateWorldMatrix(false, true);
}

function aim(bone, end, goal, share = 1) {
  const [here, there] = [placeOf(end).sub(placeOf(bone)).normalize(), goal.clone().sub(placeOf(bone)).normalize()];
  turn(bone, new Quaternion().slerp(new Quaternion().setFromUnitVectors(here, there), share));
}

// The upper and the lower bone in the plane in which they are bent, as far as the limb reaches.
function bend([upper, lower, end], goal) {
  const [a, b, c] = [upper, lower, end].map(placeOf);
  const [first, second] = [a.distanceTo(b), b.distanceTo(c)];
  const far = Math.min(Math.max(a.distanceTo(goal), Math.abs(first - second) + 1e-3), STRETCHED * (first + second));
  const axis = b.clone().sub(a).cross(c.clone().sub(b));
  if (axis.length() > 1e-6) {
    const cosine = (first ** 2 + second ** 2 - far ** 2) / (2 * first * second);
    const wanted = Math.PI - Math.acos(Math.min(Math.max(cosine, -1), 1));
    const now = b.clone().sub(a).angleTo(c.clone().sub(b));
    turn(lower, new Quaternion().setFromAxisAngle(axis.normalize(), wanted - now));
  }
  aim(upper, end, goal);
}

// The bones from the one above `end` up to below the pelvis.
function trunk(bones, end) {
  const chain = [];
  for (let bone = end.parent; bone && bone !== bones.get("pelvis"); bone = bone.parent) chain.push(bone);
  return chain;
}

// The trunk before limbs, which hang from it.
export const inOrder = (joints) => [...joints].sort((one, other) => one.includes("_") - other.includes("_"));

// The bone of a figure at whose place a joint of ours ends: a character's hand may have none but the wrist.
function endOf(bones, joint) {
  const [side, name] = joint.split("_");
  return name in LIMBS ? LIMBS[name][2].map((each) => bones.get(`${side}_${each}`)).find(Boolean) : bones.get(joint);
}

// Where the limb of a figure ends that a joint of ours ends: a character's arms and trunk are longer or shorter.
export const endOn = ({ joints, bones }, joint) => placeOf(endOf(bones, joint) ?? joints.get(joint));

// Where the figure is taken hold of by this joint: of a hand without a bone, beyond the wrist.
export function gripOn({ joints, bones }, joint) {
  const [side, name] = joint.split("_");
  const [end, wrist] = [endOf(bones, joint), bones.get(`${side}_wrist`)];
  const place = placeOf(end ?? joints.get(joint));
  if (name !== "hand" || !end || end !== wrist) return place;
  return place.add(place.clone().sub(placeOf(bones.get(`${side}_elbow`))).multiplyScalar(PALM));
}

// Pulls the limb of a joint so that it ends at `goal`. Returns what undoes it: the figure's animation does not.
export function pull({ group, bones }, joint, goal) {
  group.updateMatrixWorld(true);
  const [side, name] = joint.split("_");
  const limb = LIMBS[name];
  const find = (each) => bones.get(`${side}_${each}`);
  const end = endOf(bones, joint);
  const chain = limb ? [find(limb[0]), find(limb[1])] : end ? trunk(bones, end) : [];
  if (!end || chain.includes(undefined)) return () => {}; // bones that the file's scene does not have
  const before = chain.map((bone) => bone.quaternion.clone());
  if (limb) bend([...chain, end], goal);
  else for (let round = 0; round < ROUNDS; round++) for (const bone of chain) aim(bone, end, goal, SHARE);
  return () => chain.forEach((bone, index) => bone.quaternion.copy(before[index]));
}
