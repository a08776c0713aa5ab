// What constraints look like in the room: paths on the floor, balls where hands and feet shall be. Knows constraints as
// the document has them ({kind, id, …}; x, y and z with z up), and draws each value by its control, whatever the kind.

import {
  BufferGeometry, DoubleSide, Float32BufferAttribute, Group, Line, LineBasicMaterial, Mesh, MeshBasicMaterial, RingGeometry, SphereGeometry,
} from "./vendor/three.module.min.js";
import { kindOf, spanOf } from "./constraints.js";

const COLOUR = 0xe5484d;
const GRIP = 0.055; // metres, from a camera that is NEAR
const NEAR = 5;

// A band along points on the floor ([x, z], y up), `width` metres wide.
export function ribbon(points, width, height) {
  const corners = [];
  for (let at = 1; at < points.length; at++) {
    const [[ax, az], [bx, bz]] = [points[at - 1], points[at]];
    const length = Math.hypot(bx - ax, bz - az);
    if (length < 1e-5) continue;
    const [sx, sz] = [((bz - az) / length) * (width / 2), ((ax - bx) / length) * (width / 2)];
    const [a, b, c, d] = [[ax + sx, az + sz], [ax - sx, az - sz], [bx + sx, bz + sz], [bx - sx, bz - sz]];
    for (const [x, z] of [a, c, b, b, c, d]) corners.push(x, height, z);
  }
  return new BufferGeometry().setAttribute("position", new Float32BufferAttribute(corners, 3));
}

// From a third of a metre to a metre ahead (z).
function arrowOf() {
  const corners = [[-0.02, 0.35], [-0.02, 0.82], [0.02, 0.82], [-0.02, 0.35], [0.02, 0.82], [0.02, 0.35], [-0.09, 0.82], [0, 1], [0.09, 0.82]];
  const places = corners.flatMap(([x, z]) => [x, 0.014, z]);
  return new BufferGeometry().setAttribute("position", new Float32BufferAttribute(places, 3));
}

const line = (points) => ribbon(points.map(([x, y]) => [x, -y]), 0.035, 0.012);

export function createGizmos(scene) {
  const group = new Group();
  const ink = new LineBasicMaterial({ color: COLOUR });
  const band = new MeshBasicMaterial({ color: COLOUR, side: DoubleSide });
  const solid = new MeshBasicMaterial({ color: COLOUR, transparent: true, opacity: 0.9, side: DoubleSide });
  const pale = new MeshBasicMaterial({ color: COLOUR, transparent: true, opacity: 0.5, side: DoubleSide });
  const ball = new SphereGeometry(0.045, 20, 14);
  const arrow = arrowOf();
  const ring = new RingGeometry(0.06, 0.08, 28).rotateX(-Math.PI / 2).translate(0, 0.012, 0);
  const sketch = new Mesh(line([]), band);
  sketch.frustumCulled = false;
  const grips = createGrips(scene);
  scene.add(group, sketch);
  let targets = new Map(); // id → {mark: ball, shift: how far it is drawn from where it is}
  let headings = []; // [{mark, start, end}]

  function lineOf(constraint, points) {
    group.add(new Mesh(line(points), band));
    const [x, y] = points.at(-1);
    const end = new Mesh(ring, solid);
    end.position.set(x, 0, -y);
    group.add(end);
  }

  function ballOf(constraint, [x, y, z], chosen, shiftOf) {
    const mark = new Mesh(ball, chosen === constraint.id ? solid : pale);
    const shift = shiftOf(constraint);
    mark.position.set(x, z, -y).add(shift);
    group.add(mark);
    const drop = [mark.position.clone().setY(0), mark.position].flatMap((place) => place.toArray());
    group.add(new Line(new BufferGeometry().setAttribute("position", new Float32BufferAttribute(drop, 3)), ink));
    targets.set(constraint.id, { mark, shift });
  }

  // On the floor, from the person to where the body shall look.
  function arrowAt(constraint, angle, chosen) {
    const mark = new Mesh(arrow, chosen === constraint.id ? solid : pale);
    mark.rotation.y = angle;
    group.add(mark);
    headings.push({ mark, ...spanOf(constraint, Infinity) });
  }

  const DRAW = { line: lineOf, point: ballOf, angle: arrowAt };

  return {
    grips,
    // `shiftOf(constraint)`: by how much a place is drawn elsewhere.
    show(constraints, chosen, shiftOf) {
      for (const { geometry } of group.children) if (![ball, ring, arrow].includes(geometry)) geometry.dispose();
      group.clear();
      targets = new Map();
      headings = [];
      for (const constraint of constraints)
        for (const { name, control } of kindOf(constraint.kind).fields) DRAW[control]?.(constraint, constraint[name], chosen, shiftOf);
    },
    // Headings stand where the person is, while they hold.
    at(time, { x, z }) {
      for (const { mark, start, end } of headings) {
        mark.visible = start <= time && time <= end;
        mark.position.set(x, 0, z);
      }
    },
    sketch(points) {
      sketch.geometry.dispose();
      sketch.geometry = line(points);
    },
    hit(caster) {
      const [first] = caster.intersectObjects([...targets.values()].map(({ mark }) => mark), false);
      return first ? [...targets].find(([, { mark }]) => mark === first.object)[0] : null;
    },
    target: (id) => targets.get(id),
  };
}

// What a hand takes a pose by: balls that are seen through the body, as large from far as from near.
function createGrips(scene) {
  const group = new Group();
  const ball = new SphereGeometry(GRIP, 20, 14);
  const over = { depthTest: false, depthWrite: false, transparent: true };
  const [rim, core] = [new MeshBasicMaterial({ color: 0xffffff, opacity: 0.95, ...over }), new MeshBasicMaterial({ color: COLOUR, ...over })];
  scene.add(group);

  function gripOf(joint) {
    const [outer, inner] = [new Mesh(ball, rim), new Mesh(ball, core)];
    outer.name = joint;
    [outer.renderOrder, inner.renderOrder] = [10, 11];
    inner.scale.setScalar(0.7);
    outer.add(inner);
    return outer;
  }

  return {
    // For these joints; none: nothing is to be pulled.
    show(joints) {
      group.clear();
      if (joints.length) group.add(...joints.map(gripOf));
    },
    any: () => group.children.length > 0,
    seen: (on) => (group.visible = on),
    place(placeOf, camera) {
      for (const grip of group.children) {
        grip.position.copy(placeOf(grip.name));
        grip.scale.setScalar(camera.position.distanceTo(grip.position) / NEAR);
      }
    },
    // The joint whose grip a ray meets, or null.
    hit({ ray }) {
      const met = group.children.filter(({ position, scale }) => ray.distanceToPoint(position) < 1.4 * GRIP * scale.x);
      const far = ({ position }) => position.distanceTo(ray.origin);
      return met.sort((one, other) => far(one) - far(other))[0]?.name ?? null;
    },
  };
}
