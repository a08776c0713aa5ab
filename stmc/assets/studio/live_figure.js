// The mannequin as a stream moves it. Knows frames as the server sends them; knows no server.

import { Quaternion } from "./vendor/three.module.min.js";
import { figureOf, nearest, smoothed } from "./figure.js";

const UPRIGHT = new Quaternion(-Math.SQRT1_2, 0, 0, Math.SQRT1_2); // from z up, as frames have it, to y up

// Of the mannequin's file, and of a stream's frame rate and names of joints.
export async function streamedFigure(bytes, { fps, joints }) {
  const figure = await figureOf(bytes);
  const bones = joints.map((name) => figure.joints.get(name));
  const places = { times: [], values: [] }; // of the pelvis
  const poses = []; // of each frame: a quaternion of each joint

  function add(frames) {
    for (const { seconds, root: [x, y, z], rotations } of frames) {
      places.times.push(seconds);
      places.values.push(x, z, -y);
      const pose = rotations.map(([real, i, j, k]) => new Quaternion(i, j, k, real));
      pose[0].premultiply(UPRIGHT);
      poses.push(pose);
    }
  }

  function pose(time) {
    const at = Math.min(Math.max(time * fps, 0), poses.length - 1);
    const [before, after] = [Math.floor(at), Math.min(Math.floor(at) + 1, poses.length - 1)];
    const share = at - before;
    bones.forEach((bone, joint) => bone.quaternion.slerpQuaternions(poses[before][joint], poses[after][joint], share));
    const place = (axis) => (1 - share) * places.values[3 * before + axis] + share * places.values[3 * after + axis];
    bones[0].position.set(place(0), place(1), place(2));
  }

  return { ...figure, add, pose, followed: (time) => smoothed(places, time), placed: (time) => nearest(places, time) };
}
