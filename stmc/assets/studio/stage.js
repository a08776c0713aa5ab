// The room: figures side by side over a floor, one camera for all, and marks of constraints to draw and to drag.
// Knows figures, times and places (metres; x, y and z as glTF has them, y up); knows no server and no document.

import { Color, PCFSoftShadowMap, PerspectiveCamera, Plane, Raycaster, Scene, Vector2, Vector3, WebGLRenderer } from "./vendor/three.module.min.js";
import { OrbitControls } from "./vendor/OrbitControls.js";
import { jointOf, spanOf } from "./constraints.js";
import { createGizmos } from "./gizmos.js";
import { endOn, gripOn, inOrder, pull } from "./pulling.js";
import { floorOf, lit } from "./room.js";

const HEIGHT = 0.9; // metres above the floor that the camera looks at
const TALL = 1.8; // metres of a figure that the camera sees from there; from farther away if it is taller
const SIDE = [2.6, 1.0, 4.2]; // metres from there to the camera
const ROOM = 1.02; // of the picture for what is within bounds
const FARTHEST = 40; // metres
const fovOf = (width, height) => (width < height ? 40 : 32); // degrees
const FLOOR = new Plane(new Vector3(0, 1, 0), 0);
const SLOW = 50; // milliseconds between moving pictures above which they are drawn coarser: motions have 20 a second
const SLOW_PICTURES = 3; // that follow one another before that
const COARSE = 110e3; // pixels of a coarser picture, but at least half of the width
const STANDS = 300; // milliseconds after which a picture that stands is drawn with all pixels
const MOVED = 0.01; // metres from which on a hand has pulled rather than clicked

// `tell`: {drawn(points), moved(id, point, finished), chosen(id), pulled(joint, point, finished)}, what the hand does in
// the room; null: nothing but to turn the camera.
export function createStage(host, tell = null) {
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const renderer = new WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  renderer.shadowMap.enabled = true;
  renderer.shadowMap.type = PCFSoftShadowMap;
  const sharp = Math.min(devicePixelRatio || 1, 2); // pixels of the picture per pixel of the page
  renderer.setPixelRatio(sharp);
  renderer.domElement.setAttribute("role", "img");
  renderer.domElement.setAttribute("aria-label", "The person in the room: drag to turn the camera");
  host.prepend(renderer.domElement);
  const scene = new Scene();
  const camera = new PerspectiveCamera(32, 1, 0.05, 200);
  camera.position.set(2.6, 1.9, 4.2);
  const controls = new OrbitControls(camera, renderer.domElement);
  controls.target.set(0, HEIGHT, 0);
  let bounds = null; // {middle, height, radius} that the camera has in its picture, else it stands near a person
  let turn = 0; // radians about the upright axis by which the camera's first side is another one
  controls.enableDamping = !calm;
  controls.maxPolarAngle = 0.495 * Math.PI;
  controls.minDistance = 1.2;
  controls.maxDistance = FARTHEST;
  const light = lit(scene);
  const floor = floorOf(scene);
  const marks = createGizmos(scene);

  let figures = []; // [{key, figure}], one view each
  let main = 0; // the view that the camera follows first
  let time = 0;
  let follows = true;
  let colours = () => [0.6, 0.6, 0.65];
  let stale = false;
  let awaited = 0; // the frame that is asked for: none while the room stands still
  let last = null; // where the followed figure was
  let tool = null; // {kind, points, …} while a hand draws or drags
  let drawing = null; // seconds at which a drawn path begins
  let pulls = new Map(); // joint → {grip, end}: where a hand has pulled them at this time, until another motion comes
  let marked = [[], null]; // constraints, and the chosen one's id
  let restore = []; // what undoes them in the figure
  let pictures = 0; // drawn so far
  let [slow, shown, before, standing] = [0, 0, Infinity, null]; // slow pictures, the last one's time, when it was drawn, a timer

  const awaitFrame = () => (awaited ||= requestAnimationFrame(render));
  function invalidate() {
    stale = true;
    awaitFrame();
  }
  controls.addEventListener("change", invalidate);
  new ResizeObserver(() => {
    renderer.setSize(host.clientWidth, host.clientHeight, false);
    if (bounds) fit(camera.position.clone().sub(controls.target));
    invalidate();
  }).observe(host);

  // ---- views ----------------------------------------------------------------------------------------------------------
  const columns = () => {
    const count = Math.max(figures.length, 1);
    if (count <= 1) return 1;
    return host.clientWidth < 560 ? Math.min(count, 2) : count === 4 && host.clientWidth < 1000 ? 2 : count;
  };

  function cells() {
    const count = Math.max(figures.length, 1);
    const across = columns();
    const down = Math.ceil(count / across);
    const [width, height] = [host.clientWidth / across, host.clientHeight / down];
    return Array.from({ length: count }, (_, index) => ({
      x: (index % across) * width, y: Math.floor(index / across) * height, width, height,
    }));
  }

  function keepUp() {
    const figure = figures[main]?.figure;
    if (!figure) return;
    const here = figure.followed(time);
    if (follows && last) {
      const moved = here.clone().sub(last);
      camera.position.add(moved);
      controls.target.add(moved);
    }
    last = here;
  }

  // While time moves on a slow machine (WebGL in software, say), pictures are coarser; one that stands has all pixels.
  // Figures side by side are compared, and keep all of them.
  function pace(now) {
    if (time === shown) [slow, before] = [Math.min(slow, SLOW_PICTURES - 1), Infinity];
    else {
      if (slow < SLOW_PICTURES) slow = now - before > SLOW ? slow + 1 : before === Infinity ? slow : 0;
      before = now;
    }
    shown = time;
    const fewer = Math.sqrt(COARSE / (host.clientWidth * host.clientHeight || 1));
    const ratio = slow < SLOW_PICTURES || figures.length > 1 ? sharp : Math.max(sharp / 2, Math.min(sharp, fewer));
    if (ratio !== renderer.getPixelRatio()) renderer.setPixelRatio(ratio);
    clearTimeout(standing);
    if (ratio < sharp) standing = setTimeout(invalidate, STANDS);
  }

  function render(now) {
    awaited = 0;
    if (controls.enabled) controls.update(); // a camera that swings on tells of it
    if (!stale) return;
    stale = false;
    awaitFrame(); // whatever moves needs the very next one, too
    pace(now);
    keepUp();
    release();
    for (const { figure } of figures) figure.pose(time);
    paintFigures();
    if (figures[main]) restore = inOrder(pulls.keys()).map((joint) => pull(figures[main].figure, joint, pulls.get(joint).end));
    if (marks.grips.any() && figures[main]) marks.grips.place(gripAt, camera);
    renderer.setScissorTest(false);
    renderer.clear(); // the cells need not fill the stage
    renderer.setScissorTest(true);
    cells().forEach((cell, index) => renderView(cell, index));
    host.dataset.time = time.toFixed(3);
    host.dataset.pictures = ++pictures;
  }

  // Paints the body parts of all figures, and returns their colours as a text.
  function paintFigures() {
    const painted = [];
    for (const { figure } of figures) {
      figure.paint((part) => {
        const colour = colours(part, time);
        painted.push(colour);
        return colour;
      });
    }
    return painted.join();
  }

  function renderView({ x, y, width, height }, index) {
    const bottom = host.clientHeight - y - height;
    renderer.setViewport(x, bottom, width, height);
    renderer.setScissor(x, bottom, width, height);
    figures.forEach(({ figure }, other) => (figure.group.visible = other === index));
    const here = figures[index]?.figure.followed(time) ?? new Vector3();
    const shift = follows && last ? here.clone().sub(last) : new Vector3();
    camera.aspect = width / height;
    camera.fov = fovOf(width, height);
    camera.updateProjectionMatrix();
    camera.position.add(shift);
    camera.updateMatrixWorld();
    light.position.set(here.x + 2.5, 5, here.z + 2);
    light.target.position.copy(here);
    light.target.updateMatrixWorld();
    floor.centre(here);
    marks.at(time, here);
    marks.grips.seen(index === main && figures.length > 0);
    renderer.render(scene, camera);
    camera.position.sub(shift);
    camera.updateMatrixWorld();
  }

  function release() {
    restore.reverse().forEach((act) => act());
    restore = [];
  }

  const gripAt = (joint) => pulls.get(joint)?.grip.clone() ?? gripOn(figures[main].figure, joint);

  // From where our body has a joint at a time to where the figure that is shown has its grip, and the end of its limb.
  function shiftsAt(joint, seconds) {
    const figure = figures[main]?.figure;
    if (!figure?.joints.has(joint)) return { shift: new Vector3(), end: new Vector3() };
    release();
    figure.pose(seconds);
    figure.group.updateMatrixWorld(true);
    const ours = figure.joints.get(joint).getWorldPosition(new Vector3());
    return { shift: gripOn(figure, joint).sub(ours), end: endOn(figure, joint).sub(ours) };
  }

  function mark() {
    marks.show(...marked, (constraint) => shiftsAt(jointOf(constraint), spanOf(constraint, Infinity).start).shift);
    invalidate();
  }

  // ---- the hand -------------------------------------------------------------------------------------------------------
  const caster = new Raycaster();
  function aim(event) {
    const box = renderer.domElement.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const cell = cells()[main] ?? cells()[0];
    camera.aspect = cell.width / cell.height;
    camera.updateProjectionMatrix();
    caster.setFromCamera(new Vector2((2 * (x - cell.x)) / cell.width - 1, 1 - (2 * (y - cell.y)) / cell.height), camera);
    return caster;
  }

  function down(event) {
    if (event.button || !tell) return;
    tool = drawing === null ? gripped(aim(event)) : { kind: "path", points: begun() };
    if (!tool) return;
    controls.enabled = false;
    renderer.domElement.setPointerCapture(event.pointerId);
    move(event);
  }

  // A path that is drawn begins at the figure.
  function begun() {
    const place = figures[main]?.figure.placed(drawing);
    return place ? [[place.x, -place.z]] : [];
  }

  // What a ray takes hold of: a joint of the pose, or the place of a constraint.
  function gripped(caster) {
    const joint = figures.length ? marks.grips.hit(caster) : null;
    const id = joint === null ? marks.hit(caster) : null;
    if (joint === null && id === null) return null;
    const start = joint === null ? marks.target(id).mark.position.clone() : gripAt(joint);
    const { shift, end } = joint === null ? marks.target(id) : shiftsAt(joint, time);
    const plane = new Plane().setFromNormalAndCoplanarPoint(camera.getWorldDirection(new Vector3()), start);
    if (id !== null) tell.chosen(id);
    const off = caster.ray.intersectPlane(plane, new Vector3()).sub(start).add(shift);
    return { kind: joint === null ? "target" : "pose", id, joint, plane, shift, end, off, point: start.clone().sub(shift) };
  }

  function hover(event) {
    const over = !event.buttons && drawing === null && marks.grips.any() && figures.length > 0 && marks.grips.hit(aim(event)) !== null;
    renderer.domElement.classList.toggle("gripping", over || tool?.kind === "pose");
  }

  function move(event) {
    if (tell) hover(event);
    if (!tool) return;
    const point = aim(event).ray.intersectPlane(tool.kind === "path" ? FLOOR : tool.plane, new Vector3());
    if (!point || point.length() > 100) return;
    if (tool.kind === "path") {
      tool.points.push([point.x, -point.z]);
      marks.sketch(tool.points);
    } else {
      point.sub(tool.off).setY(Math.max(0, point.y));
      if (!tool.dragged && point.distanceTo(tool.point) < MOVED) return;
      Object.assign(tool, { point, dragged: true });
      if (tool.kind === "pose") pulls.set(tool.joint, { grip: point.clone().add(tool.shift), end: point.clone().add(tool.end) });
      said(tool, false);
    }
    invalidate();
  }

  function said({ kind, id, joint, point: { x, y, z } }, finished) {
    if (kind === "pose") tell.pulled(joint, [x, -z, y], finished);
    else tell.moved(id, [x, -z, y], finished);
  }

  function up() {
    if (!tool) return;
    const done = tool;
    tool = null;
    controls.enabled = true;
    marks.sketch([]);
    if (done.kind === "path") tell.drawn(done.points);
    else if (done.dragged) said(done, true);
    invalidate();
  }

  renderer.domElement.addEventListener("pointerdown", down);
  renderer.domElement.addEventListener("pointermove", move);
  for (const end of ["pointerup", "pointercancel"]) renderer.domElement.addEventListener(end, up);

  const larger = () => Math.max(1, (figures[main]?.figure.height ?? 0) / TALL);

  function reset() {
    fit(new Vector3(...SIDE).multiplyScalar(larger()).applyAxisAngle(new Vector3(0, 1, 0), turn));
  }

  // The camera `away` from where it looks, and as far as it takes to see all of the bounds in any view.
  function fit(away) {
    const here = figures[main]?.figure.followed(time) ?? new Vector3();
    const { x, z } = bounds?.middle ?? here;
    controls.target.set(x, bounds?.height ?? HEIGHT * larger(), z);
    if (bounds) {
      const { width, height } = cells()[0];
      const half = (fovOf(width, height) * Math.PI) / 360;
      const across = Math.atan(Math.tan(half) * (width / height || 1));
      away.setLength((ROOM * bounds.radius) / Math.sin(Math.min(half, across)));
    }
    controls.maxDistance = Math.max(FARTHEST, away.length());
    camera.position.copy(controls.target).add(away);
    last = here;
    invalidate();
  }

  invalidate();
  return {
    cells,
    reset,
    // [{key, figure}] in the order of their views; `chosen` is the one that the camera follows.
    show(next, chosen) {
      const arrived = !figures.length && next.length;
      release();
      pulls = new Map();
      for (const { group } of figures.map(({ figure }) => figure)) scene.remove(group);
      figures = next;
      for (const { figure } of figures) scene.add(figure.group);
      main = Math.max(0, figures.findIndex(({ key }) => key === chosen));
      last = figures.length ? figures[main].figure.followed(time) : null;
      if (arrived || follows) reset();
      mark();
    },
    at(seconds) {
      if (seconds !== time) pulls = new Map();
      time = seconds;
      invalidate();
    },
    refresh: invalidate,
    colour(next) {
      const before = paintFigures();
      colours = next;
      if (paintFigures() !== before) invalidate();
    },
    follow(on) {
      follows = on;
      if (on) reset();
    },
    // What the camera has in its picture from now on (null: a person from near), and from which side at first.
    aim(next, side = turn) {
      [bounds, turn] = [next, side];
      reset();
    },
    // A path that begins at so many seconds (null: none) is drawn by hand.
    draw(seconds) {
      drawing = seconds;
      renderer.domElement.classList.toggle("drawing", seconds !== null);
    },
    // The joints by which the pose can be pulled.
    grip(joints) {
      marks.grips.show(joints);
      invalidate();
    },
    mark(constraints, chosen) {
      marked = [constraints, chosen];
      mark();
    },
    // Where a joint of the chosen figure is (x, y and z with z up), or null.
    joint(name) {
      const bone = figures[main]?.figure.joints.get(name);
      if (!bone) return null;
      figures[main].figure.pose(time);
      figures[main].figure.group.updateMatrixWorld(true);
      const { x, y, z } = bone.getWorldPosition(new Vector3());
      return [x, -z, y].map((value) => Math.round(value * 1000) / 1000);
    },
    theme(style) {
      renderer.setClearColor(new Color(style.room));
      floor.theme(style);
      for (const { figure } of figures) figure.paintWay(style.way);
      invalidate();
    },
    // A small picture of the chosen view, as a data address.
    picture(width) {
      const cell = cells()[main] ?? cells()[0];
      const canvas = Object.assign(document.createElement("canvas"), { width, height: width });
      const ratio = renderer.getPixelRatio();
      const side = Math.min(cell.width, cell.height);
      const [left, top] = [cell.x + (cell.width - side) / 2, cell.y + (cell.height - side) / 2];
      canvas.getContext("2d").drawImage(renderer.domElement, left * ratio, top * ratio, side * ratio, side * ratio, 0, 0, width, width);
      return canvas.toDataURL("image/jpeg", 0.8);
    },
  };
}
