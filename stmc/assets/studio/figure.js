// A person of a .glb file: the skinned figure, its animations, and the way of its pelvis over the floor. Knows no timeline.

import { AnimationMixer, DoubleSide, Group, Mesh, MeshBasicMaterial, SRGBColorSpace, Vector3 } from "./vendor/three.module.min.js";
import { GLTFLoader } from "./vendor/GLTFLoader.js";
import { ribbon } from "./gizmos.js";

const loader = new GLTFLoader();
const SWAY = 0.35; // seconds over which the followed way is smoothed
const FLESH = 0.24; // metres by which the body is larger than its joints: the skull, the hands
const LOOKS = 60; // poses by which the size of a motion is measured

// Of a file that stands in a page as base64.
export const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;

export const parsed = (bytes) => loader.parseAsync(bytes, "");

// Our own figure, of a file that has it and its animations.
export async function figureOf(bytes) {
  const { scene, animations } = await parsed(bytes);
  const materials = new Map(); // body part → material
  const joints = new Map(); // name → bone
  scene.traverse((node) => {
    if (node.isBone) joints.set(node.name, node);
    if (!node.isMesh) return;
    node.castShadow = true;
    node.frustumCulled = false; // the bounds of a skinned mesh are those of its rest pose
    materials.set(node.material.name, node.material);
  });
  return animated({
    body: scene, animations, joints, bones: joints,
    paint(colourOf) {
      for (const [part, material] of materials) material.color.setRGB(...colourOf(part), SRGBColorSpace);
    },
    dispose: () => disposeOf(scene),
  });
}

export function disposeOf(root) {
  root.traverse((node) => {
    node.geometry?.dispose();
    node.material?.dispose();
    node.skeleton?.dispose();
  });
}

// A figure of a `body` that `animations` move. `joints`: where our joints are, by their names, "pelvis" among them;
// `bones`: the nodes of the body that turn with them.
export function animated({ body, animations, joints, bones, paint, dispose, ...more }) {
  const mixer = new AnimationMixer(body);
  const group = new Group();
  const way = new Mesh(ribbon([], 0, 0), new MeshBasicMaterial({ transparent: true, opacity: 0.6, side: DoubleSide, depthWrite: false }));
  group.add(body, way);
  let clip = null;
  let places = null; // of the pelvis

  const figure = {
    group,
    joints,
    bones,
    paint,
    ...more,
    // Which of the file's animations plays.
    choose(name) {
      clip = animations.find((each) => each.name === name);
      places = clip.tracks.find((track) => track.name.endsWith("pelvis.position"));
      figure.duration = clip.duration;
      mixer.stopAllAction(); // what another animation has scaled is as it was again
      mixer.clipAction(clip).play();
      way.geometry.dispose();
      way.geometry = ribbon(wayOf(places), 0.018, 0.006);
    },
    pose(time) {
      mixer.setTime(Math.min(Math.max(time, 0), Math.max(clip.duration - 1e-4, 0)));
    },
    paintWay(colour) {
      way.visible = Boolean(colour);
      if (colour) way.material.color.set(colour);
    },
    // Where the camera looks at a time: the pelvis without its swaying.
    followed: (time) => smoothed(places, time),
    // Where the pelvis is over the floor.
    placed: (time) => nearest(places, time),
    // The ball around the body at all times: about where it is followed, or about the middle of its way.
    bounds: (follows) => ballOf(figure, follows ? null : middleOf(places)),
    dispose() {
      disposeOf(way);
      dispose();
    },
  };
  figure.choose(animations[0].name);
  return figure;
}

function wayOf({ values }) {
  const points = [];
  for (let at = 0; at < values.length; at += 3) points.push([values[at], values[at + 2]]);
  return points;
}

export function nearest({ times, values }, time) {
  const step = times.length > 1 ? times[1] - times[0] : 1;
  const frame = Math.min(Math.max(Math.round(time / step), 0), times.length - 1);
  return new Vector3(values[3 * frame], 0, values[3 * frame + 2]);
}

function middleOf(places) {
  const [low, high] = [new Vector3(Infinity, 0, Infinity), new Vector3(-Infinity, 0, -Infinity)];
  for (const [x, z] of wayOf(places)) {
    low.min(new Vector3(x, 0, z));
    high.max(new Vector3(x, 0, z));
  }
  return low.add(high).multiplyScalar(0.5);
}

function ballOf(figure, middle) {
  const points = []; // [place beside the middle, flesh around]
  let [low, high] = [Infinity, -Infinity];
  for (let look = 0; look <= LOOKS; look++) {
    const time = (figure.duration * look) / LOOKS;
    figure.pose(time);
    figure.group.updateMatrixWorld(true);
    const centre = middle ?? figure.followed(time);
    for (const bone of figure.joints.values()) {
      const place = bone.getWorldPosition(new Vector3());
      const flesh = FLESH * bone.getWorldScale(new Vector3()).x;
      low = Math.min(low, place.y - flesh);
      high = Math.max(high, place.y + flesh);
      points.push([place.sub(centre), flesh]);
    }
  }
  const height = (low + high) / 2;
  const away = ({ x, y, z }) => Math.hypot(x, y - height, z);
  return { middle, height, radius: Math.max(...points.map(([place, flesh]) => away(place) + flesh)) };
}

export function smoothed({ times, values }, time) {
  const sum = new Vector3();
  let total = 0;
  const step = times.length > 1 ? times[1] - times[0] : 1;
  const first = Math.max(0, Math.floor((time - 2 * SWAY) / step));
  const last = Math.min(times.length - 1, Math.ceil((time + 2 * SWAY) / step));
  for (let frame = Math.min(first, last); frame <= last; frame++) {
    const weight = Math.exp(-0.5 * ((times[frame] - time) / SWAY) ** 2) + 1e-9;
    total += weight;
    sum.add(new Vector3(values[3 * frame], 0, values[3 * frame + 2]).multiplyScalar(weight));
  }
  return sum.divideScalar(total);
}
