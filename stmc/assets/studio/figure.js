// A person of a .glb file: the skinned figure, its animation, and the way of its pelvis over the floor. Knows no timeline.

import { AnimationMixer, DoubleSide, Group, Mesh, MeshBasicMaterial, SRGBColorSpace, Vector3 } from "./vendor/three.module.min.js";
import { GLTFLoader } from "./vendor/GLTFLoader.js";
import { ribbon } from "./marks.js";

const loader = new GLTFLoader();
const SWAY = 0.35; // seconds over which the followed way is smoothed

export async function figureOf(bytes) {
  const file = await loader.parseAsync(bytes, "");
  const [clip] = file.animations;
  const mixer = new AnimationMixer(file.scene);
  mixer.clipAction(clip).play();
  const materials = new Map(); // body part → material
  const joints = new Map(); // name → bone
  file.scene.traverse((node) => {
    if (node.isBone) joints.set(node.name, node);
    if (!node.isMesh) return;
    node.castShadow = true;
    node.frustumCulled = false; // the bounds of a skinned mesh are those of its rest pose
    materials.set(node.material.name, node.material);
  });
  const places = clip.tracks.find(({ name }) => name.endsWith("pelvis.position"));
  const group = new Group();
  group.add(file.scene);
  const way = wayOf(places);
  group.add(way);

  return {
    group,
    joints,
    duration: clip.duration,
    pose(time) {
      mixer.setTime(Math.min(Math.max(time, 0), Math.max(clip.duration - 1e-4, 0)));
    },
    paint(colourOf) {
      for (const [part, material] of materials) material.color.setRGB(...colourOf(part), SRGBColorSpace);
    },
    paintWay(colour) {
      way.material.color.set(colour);
    },
    // Where the camera looks at a time: the pelvis without its swaying.
    followed: (time) => smoothed(places, time),
    dispose() {
      group.traverse((node) => {
        node.geometry?.dispose();
        node.material?.dispose();
      });
    },
  };
}

function wayOf({ values }) {
  const points = [];
  for (let at = 0; at < values.length; at += 3) points.push([values[at], values[at + 2]]);
  const material = new MeshBasicMaterial({ transparent: true, opacity: 0.6, side: DoubleSide, depthWrite: false });
  return new Mesh(ribbon(points, 0.018, 0.006), material);
}

function smoothed({ times, values }, time) {
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
