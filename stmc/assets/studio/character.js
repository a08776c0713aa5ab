// A character that a user has brought: its mesh once, and a figure of it for each motion, from the poses that the server
// computes (`stage_poses` in stmc/formats/characters). Knows the file of a character; knows no server.

import { Box3, BufferAttribute, Color, Group, MeshStandardMaterial, SRGBColorSpace, Vector3 } from "./vendor/three.module.min.js";
import { clone } from "./vendor/SkeletonUtils.js";
import { animated, disposeOf, parsed } from "./figure.js";
import { PARTS } from "./state.js";

export async function characterOf(bytes) {
  const { scene, parser } = await parsed(bytes);
  if (!scene) throw new Error("its file has no scene to show.");
  const strange = []; // lights and cameras, which the room has of its own
  scene.traverse((node) => {
    const number = parser.associations.get(node)?.nodes;
    node.name = number === undefined ? "" : `n${number}`; // as the poses call it
    if (node.isLight || node.isCamera) strange.push(node);
    if (!node.isMesh) return;
    node.castShadow = true;
    node.frustumCulled = false; // the bounds of a skinned mesh are those of its rest pose
  });
  for (const node of strange) node.removeFromParent();
  const height = new Box3().setFromObject(scene).max.y; // at rest
  return {
    figure: async (poses) => figureWith(scene, height, await parsed(poses)),
    dispose() {
      scene.traverse(({ material }) => material && texturesOf(material).forEach((texture) => texture.dispose()));
      disposeOf(scene);
    },
  };
}

const texturesOf = (material) => Object.values(material).filter((value) => value?.isTexture);

function figureWith(scene, height, { scene: poses, animations }) {
  const [body, own, joints, bones, parts] = [new Group(), clone(scene), new Map(), new Map(), new Map()];
  const room = new Group(); // the character's own world within ours
  for (const node of [...poses.children]) {
    const { part, joint } = node.userData;
    if (node.name === "stage") room.applyMatrix4(node.matrix.compose(node.position, node.quaternion, node.scale));
    else if (part) {
      parts.set(node.name, PARTS.indexOf(part));
      if (joint) bones.set(joint, own.getObjectByName(node.name)); // undefined: it is not in the file's scene
    } else joints.set(node.name, node);
  }
  room.add(own);
  body.add(room, ...joints.values());
  const clothes = createClothes(own, parts);
  return animated({
    body, animations, joints, bones,
    height: height * room.scale.y,
    paint: clothes.paint,
    wear: clothes.wear,
    dispose() {
      clothes.dispose();
      own.traverse((node) => node.skeleton?.dispose());
    },
  });
}

// The materials of a figure: its own, or the colours of prompts. `parts`: body part of each driven node, by name.
function createClothes(root, parts) {
  const tints = { value: PARTS.map(() => new Vector3()) };
  const pieces = []; // {mesh, own, tinted}
  const partOf = new Map(); // node → its own body part, or that of the nearest node above with one
  root.traverse((node) => partOf.set(node, parts.get(node.name) ?? partOf.get(node.parent) ?? PARTS.indexOf("legs")));
  root.traverse((mesh) => {
    if (!mesh.isMesh) return;
    markParts(mesh, partOf);
    pieces.push({ mesh, own: mesh.material, tinted: tinted(mesh.material, tints) });
  });
  const ink = new Color();
  return {
    paint(colourOf) {
      PARTS.forEach((part, index) => {
        const { r, g, b } = ink.setRGB(...colourOf(part), SRGBColorSpace);
        tints.value[index].set(r, g, b);
      });
    },
    // "own" or "prompts".
    wear(materials) {
      for (const { mesh, own, tinted } of pieces) mesh.material = materials === "own" ? own : tinted;
    },
    dispose: () => pieces.forEach(({ tinted }) => tinted.dispose()),
  };
}

// Says of each vertex which body part carries most of it. Figures of one character share their geometry.
function markParts(mesh, partOf) {
  if (!mesh.isSkinnedMesh) mesh.geometry = mesh.geometry.clone(); // it may hang from several nodes
  else if (mesh.geometry.hasAttribute("part")) return;
  const { position, skinIndex, skinWeight } = mesh.geometry.attributes;
  const marks = new Float32Array(position.count).fill(partOf.get(mesh));
  const carried = mesh.isSkinnedMesh ? mesh.skeleton.bones.map((bone) => partOf.get(bone) ?? 0) : [];
  for (let vertex = 0; carried.length && vertex < position.count; vertex++) {
    const shares = PARTS.map(() => 0);
    for (let each = 0; each < 4; each++) shares[carried[skinIndex.getComponent(vertex, each)] ?? 0] += skinWeight.getComponent(vertex, each);
    marks[vertex] = shares.indexOf(Math.max(...shares));
  }
  mesh.geometry.setAttribute("part", new BufferAttribute(marks, 1));
}

// A matte material in the colours of body parts, on which the light and dark of the own one are still to be seen.
function tinted(own, tints) {
  const { map = null, color, alphaTest, transparent, opacity, side, vertexColors, flatShading, depthWrite } = own;
  const material = new MeshStandardMaterial({ map, color, alphaTest, transparent, opacity, side, vertexColors, flatShading, depthWrite, roughness: 0.7 });
  material.onBeforeCompile = (shader) => {
    shader.uniforms.tints = tints;
    shader.vertexShader = `attribute float part; uniform vec3 tints[${PARTS.length}]; varying vec3 tint;\n${shader.vertexShader}`
      .replace("#include <begin_vertex>", "#include <begin_vertex>\ntint = tints[int(part + 0.5)];");
    shader.fragmentShader = `varying vec3 tint;\n${shader.fragmentShader}`.replace("#include <color_fragment>", `#include <color_fragment>
      diffuseColor.rgb = tint * (0.55 + 0.55 * sqrt(clamp(dot(diffuseColor.rgb, vec3(0.2126, 0.7152, 0.0722)), 0.0, 1.0)));`);
  };
  return material;
}
