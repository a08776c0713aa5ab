// Draws clips of a body into canvases: limbs of volume over a floor, from one side for all, which the mouse turns.
// `POINTS`: how many points a clip has per frame. Knows no question and no time.
function stage(POINTS, canvases) {
  "use strict";

  // ---- motions ------------------------------------------------------------------------------------------------------
  const HEAD = 15, CROWN = 24, NOSE = 25;
  const GREY = [176, 182, 192], LEFT = [111, 149, 196], RIGHT = [207, 154, 98];
  // [from, to, radius there, radius here (metres), colour]; points 26 to 28 are made up in `posed`
  const BONES = [
    [0, 1, 0.095, 0.09, GREY], [0, 2, 0.095, 0.09, GREY], [0, 3, 0.11, 0.112, GREY], [3, 6, 0.112, 0.118, GREY],
    [6, 9, 0.118, 0.122, GREY], [9, 12, 0.1, 0.052, GREY], [12, 15, 0.05, 0.05, GREY],
    [9, 13, 0.1, 0.075, GREY], [9, 14, 0.1, 0.075, GREY],
    [13, 16, 0.07, 0.06, LEFT], [16, 18, 0.055, 0.043, LEFT], [18, 20, 0.043, 0.032, LEFT], [20, 22, 0.036, 0.034, LEFT],
    [14, 17, 0.07, 0.06, RIGHT], [17, 19, 0.055, 0.043, RIGHT], [19, 21, 0.043, 0.032, RIGHT], [21, 23, 0.036, 0.034, RIGHT],
    [1, 4, 0.088, 0.06, LEFT], [4, 7, 0.06, 0.042, LEFT], [7, 10, 0.045, 0.036, LEFT],
    [2, 5, 0.088, 0.06, RIGHT], [5, 8, 0.06, 0.042, RIGHT], [8, 11, 0.045, 0.036, RIGHT],
    [26, 27, 0.085, 0.092, GREY], [28, 25, 0.03, 0.014, GREY],
  ];
  const FLESH = 0.13; // metres by which the body is thicker than its points

  function decoded(clip) {
    const bytes = Uint8Array.from(atob(clip.points), (letter) => letter.charCodeAt(0));
    const units = new Int16Array(bytes.buffer);
    const points = Float32Array.from(units, (value) => value * clip.unit);
    const frames = points.length / (3 * POINTS);
    return { points, frames, fps: clip.fps, path: smoothed(points, frames, clip.fps) };
  }

  // Where the camera looks in each frame: the pelvis' way over the floor without its swaying.
  function smoothed(points, frames, fps) {
    const reach = Math.ceil(fps);
    const path = new Float32Array(2 * frames);
    for (let frame = 0; frame < frames; frame++) {
      let total = 0;
      for (let step = -reach; step <= reach; step++) {
        const other = Math.min(Math.max(frame + step, 0), frames - 1);
        const weight = Math.exp(-0.5 * ((2.5 * step) / reach) ** 2);
        total += weight;
        for (const axis of [0, 1]) path[2 * frame + axis] += weight * points[3 * POINTS * other + axis];
      }
      for (const axis of [0, 1]) path[2 * frame + axis] /= total;
    }
    return path;
  }

  // One ball around both bodies, the same for both, so that both are of one size and always wholly in the picture.
  function ball(clips) {
    let low = Infinity, high = -Infinity;
    for (const { points } of clips)
      for (let at = 2; at < points.length; at += 3) {
        low = Math.min(low, points[at]);
        high = Math.max(high, points[at]);
      }
    const height = (low + high) / 2;
    let radius = 0;
    for (const { points, path } of clips)
      for (let at = 0; at < points.length; at += 3) {
        const frame = Math.floor(at / (3 * POINTS));
        const x = points[at] - path[2 * frame], y = points[at + 1] - path[2 * frame + 1];
        radius = Math.max(radius, Math.hypot(x, y, points[at + 2] - height));
      }
    return { height, radius: radius + FLESH };
  }

  function posed(clip, time) {
    const at = Math.min(time * clip.fps, clip.frames - 1);
    const frame = Math.min(Math.floor(at), Math.max(clip.frames - 2, 0));
    const share = clip.frames > 1 ? at - frame : 0;
    const mixed = (array, width, index) =>
      array[width * frame + index] * (1 - share) + (share && array[width * (frame + 1) + index] * share);
    const pose = [];
    for (let point = 0; point < POINTS; point++)
      pose.push([0, 1, 2].map((axis) => mixed(clip.points, 3 * POINTS, 3 * point + axis)));
    const between = (a, b, part) => [0, 1, 2].map((axis) => pose[a][axis] * (1 - part) + pose[b][axis] * part);
    pose.push(between(HEAD, CROWN, 0.25), between(HEAD, CROWN, 0.6), between(HEAD, NOSE, 0.6));
    return { pose, target: [mixed(clip.path, 2, 0), mixed(clip.path, 2, 1)] };
  }

  // ---- pictures -----------------------------------------------------------------------------------------------------
  const FOV = (30 * Math.PI) / 180;
  const TILE = 0.5; // metres
  const view = { azimuth: -Math.PI / 2 + 0.5, elevation: 0.24 };
  const shade = (colour, share) =>
    "rgb(" + colour.map((value) => Math.round(share < 1 ? value * share : value + (255 - value) * (share - 1))) + ")";

  const distance = (around) => (1.02 * around.radius) / Math.sin(FOV / 2);

  function projector(canvas, around, target) {
    const { clientWidth: wide, clientHeight: tall } = canvas;
    const [ca, sa, ce, se] = [Math.cos(view.azimuth), Math.sin(view.azimuth), Math.cos(view.elevation), Math.sin(view.elevation)];
    const away = distance(around);
    const focal = Math.min(wide, tall) / 2 / Math.tan(FOV / 2);
    return (point) => {
      const x = point[0] - target[0], y = point[1] - target[1], z = point[2] - around.height;
      const near = ce * (ca * x + sa * y) + se * z;
      const scale = focal / (away - near);
      return { x: wide / 2 + scale * (ca * y - sa * x), y: tall / 2 - scale * (ce * z - se * (ca * x + sa * y)), scale, depth: away - near };
    };
  }

  // A round piece of floor with half-metre tiles, fading towards its rim; every other line is a metre's.
  function drawFloor(context, project, target, reach) {
    for (const axis of [0, 1]) {
      const last = Math.floor((target[axis] + reach) / TILE);
      for (let line = Math.ceil((target[axis] - reach) / TILE); line <= last; line++) {
        const aside = line * TILE - target[axis];
        const half = Math.sqrt(Math.max(reach * reach - aside * aside, 0));
        const at = (along) => project(axis ? [target[0] + along, line * TILE, 0] : [line * TILE, target[1] + along, 0]);
        const [one, other] = [at(-half), at(half)];
        const fade = context.createLinearGradient(one.x, one.y, other.x, other.y);
        const middle = 0.55 * (half / reach) ** 2;
        for (const [place, alpha] of [[0, 0], [0.25, 0.6 * middle], [0.5, middle], [0.75, 0.6 * middle], [1, 0]])
          fade.addColorStop(place, `rgba(90, 100, 118, ${alpha})`);
        context.strokeStyle = fade;
        context.lineWidth = line % 2 ? 0.7 : 1.5;
        context.beginPath();
        context.moveTo(one.x, one.y);
        context.lineTo(other.x, other.y);
        context.stroke();
      }
    }
  }

  function drawShadow(context, project, pose) {
    context.strokeStyle = "#cfd3da";
    context.lineCap = "round";
    for (const [from, to, one, other] of BONES) {
      const [a, b] = [from, to].map((point) => project([pose[point][0], pose[point][1], 0]));
      context.lineWidth = Math.max((one + other) * a.scale, 1);
      context.beginPath();
      context.moveTo(a.x, a.y);
      context.lineTo(b.x, b.y + 0.01);
      context.stroke();
    }
  }

  // A limb: the hull of two circles, lighter on the side of the light.
  function drawLimb(context, a, b, one, other, colour) {
    const length = Math.hypot(b.x - a.x, b.y - a.y);
    const along = Math.atan2(b.y - a.y, b.x - a.x);
    context.beginPath();
    if (length <= Math.abs(one - other)) {
      const end = one > other ? a : b;
      context.arc(end.x, end.y, Math.max(one, other), 0, 2 * Math.PI);
    } else {
      const open = Math.acos((one - other) / length);
      context.arc(a.x, a.y, one, along + open, along - open + 2 * Math.PI);
      context.arc(b.x, b.y, other, along - open, along + open);
      context.closePath();
    }
    let across = [-Math.sin(along), Math.cos(along)];
    if (across[0] * -0.45 + across[1] * -0.9 < 0) across = [-across[0], -across[1]];
    const [x, y, r] = [(a.x + b.x) / 2, (a.y + b.y) / 2, Math.max(one, other)];
    const fill = context.createLinearGradient(x + r * across[0], y + r * across[1], x - r * across[0], y - r * across[1]);
    fill.addColorStop(0, shade(colour, 1.28));
    fill.addColorStop(0.45, shade(colour, 1));
    fill.addColorStop(1, shade(colour, 0.68));
    context.fillStyle = fill;
    context.strokeStyle = shade(colour, 0.6);
    context.lineWidth = 1;
    context.stroke();
    context.fill();
  }

  function draw(canvas, clip, around, time) {
    const density = window.devicePixelRatio || 1;
    const [wide, tall] = [Math.round(canvas.clientWidth * density), Math.round(canvas.clientHeight * density)];
    if (canvas.width !== wide || canvas.height !== tall) [canvas.width, canvas.height] = [wide, tall];
    const context = canvas.getContext("2d");
    context.setTransform(density, 0, 0, density, 0, 0);
    context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    const { pose, target } = posed(clip, time);
    const project = projector(canvas, around, target);
    drawFloor(context, project, target, Math.min(4, 0.8 * distance(around)));
    drawShadow(context, project, pose);
    const seen = pose.map(project);
    BONES.map(([from, to, one, other, colour]) => ({ a: seen[from], b: seen[to], one, other, colour }))
      .sort((x, y) => y.a.depth + y.b.depth - x.a.depth - x.b.depth)
      .forEach(({ a, b, one, other, colour }) => drawLimb(context, a, b, one * a.scale, other * b.scale, colour));
  }

  for (const canvas of canvases) {
    let held = null;
    canvas.addEventListener("pointerdown", (event) => {
      held = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!held) return;
      view.azimuth -= (event.clientX - held[0]) * 0.01;
      view.elevation = Math.min(Math.max(view.elevation + (event.clientY - held[1]) * 0.006, 0.03), 1.4);
      held = [event.clientX, event.clientY];
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (held = null));
  }

  return { decoded, ball, draw, view };
}
