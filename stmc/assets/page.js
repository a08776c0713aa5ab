// Keeps the tracks below viser's recording in step with it. viser has no interface for its clock; the handle of its
// slider bears the time (aria-valuenow), and its number field takes one. "#t=2.5" in the address starts there, paused.
// Its camera is reached through React's own tree; where that is not as we know it, the recording's camera stays.
(() => {
  const root = document.getElementById("root");
  const tracks = document.getElementById("stmc-tracks");
  const duration = Number(document.body.dataset.duration);
  const view = JSON.parse(document.body.dataset.view);
  const button = document.getElementById("stmc-follow");
  const SMALL = 0.25; // of the picture's height: a body that is smaller is followed
  let thumb = null, time = 0, viewer = null, followed = null;

  // The record that viser's components share: it has the camera and whoever controls it.
  function found() {
    const canvas = root.querySelector("canvas");
    const key = canvas && Object.keys(canvas).find((name) => name.startsWith("__reactFiber"));
    for (let fiber = key && canvas[key]; fiber; fiber = fiber.return)
      for (let hook = fiber.memoizedState; hook && typeof hook === "object" && "next" in hook; hook = hook.next) {
        const held = hook.memoizedState && hook.memoizedState.current;
        if (held && held.cameraControl && held.camera && held.requestRender) return held;
      }
    return null;
  }

  const place = ([x, y, z]) => [-y, z, -x]; // metres, z up → three.js, as viser turns its scene
  const plus = (one, other, share = 1) => one.map((value, axis) => value + share * other[axis]);
  const slope = () => Math.tan((viewer.camera.fov * Math.PI) / 360);

  function look(position, target) {
    viewer.cameraControl.setLookAt(...position, ...target, false);
    viewer.requestRender();
  }

  function pelvis() {
    const last = view.path.length - 1;
    const at = Math.min(time * view.rate, last), before = Math.floor(at), after = Math.min(before + 1, last);
    const [x, y] = plus(view.path[before].map((v) => v * (1 - (at - before))), view.path[after], at - before);
    return place([x, y, 0.95]);
  }

  // The camera for the window as it is: the whole motion, or the body alone seen from the same side.
  function frame() {
    if (!viewer) return;
    const canvas = root.querySelector("canvas");
    const aspect = canvas.clientWidth / canvas.clientHeight;
    const fitting = view.cameras.filter((each) => each.aspect <= aspect);
    const { position, target } = fitting[fitting.length - 1] || view.cameras[0];
    const away = plus(place(position), place(target), -1);
    const distance = Math.hypot(...away);
    if (followed === null) followed = 1.8 / (2 * slope() * distance) < SMALL ? pelvis() : false;
    button.setAttribute("aria-pressed", followed !== false);
    if (followed === false) return look(place(position), place(target));
    followed = pelvis();
    const near = Math.max(2.4, 1.6 / aspect) / (2 * slope());
    look(plus(followed, away, near / distance), followed);
  }

  function keepUp() {
    if (!viewer || !followed) return;
    const here = pelvis(), moved = plus(here, followed, -1);
    const { position } = viewer.camera, target = viewer.cameraControl.getTarget(position.clone());
    followed = here;
    look(plus(position.toArray(), moved), plus(target.toArray(), moved));
  }

  // viser makes its camera some time after its canvas, and tells nobody.
  const waiting = setInterval(() => {
    viewer = found();
    if (!viewer) return;
    clearInterval(waiting);
    frame();
  }, 100);

  button.addEventListener("click", () => {
    followed = followed === false ? pelvis() : false;
    frame();
  });
  window.addEventListener("resize", frame);

  function follow() {
    time = Math.min(Number(thumb.getAttribute("aria-valuenow")), duration);
    document.body.dataset.time = time.toFixed(3);
    for (const element of document.querySelectorAll("[data-from]")) {
      const now = Number(element.dataset.from) <= time && time < Number(element.dataset.to);
      if (element.classList.contains("bar")) element.classList.toggle("now", now);
      else element.hidden = !now;
    }
    keepUp();
    if (!tracks) return;
    document.getElementById("stmc-time").textContent = time.toFixed(1) + " s";
    const cursor = document.getElementById("stmc-cursor");
    cursor.style.left = (100 * time) / duration + "%";
    cursor.style.height = cursor.parentElement.offsetTop - tracks.querySelector(".row").offsetTop + "px";
  }

  function seek(time) {
    let bar = thumb;
    const visible = "input:not([type=hidden])";
    while (bar && !bar.querySelector(visible)) bar = bar.parentElement;
    if (!bar) return;
    const field = bar.querySelector(visible);
    const value = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value");
    value.set.call(field, Math.min(Math.max(time, 0), duration).toFixed(3)); // React listens to the event, not to us
    field.dispatchEvent(new Event("input", { bubbles: true }));
    field.blur();
  }

  new MutationObserver(() => {
    const slider = root.querySelector("[role=slider]");
    if (!slider || slider === thumb) return;
    const first = thumb === null;
    thumb = slider;
    new MutationObserver(follow).observe(thumb, { attributes: true, attributeFilter: ["aria-valuenow"] });
    follow();
    const start = /[#&]t=([0-9.]+)/.exec(location.hash);
    if (first && start) seek(Number(start[1]));
  }).observe(root, { childList: true, subtree: true });

  if (!tracks) return;
  const ruler = tracks.querySelector(".ruler");
  let held = false;
  const drag = (event) => {
    const box = ruler.getBoundingClientRect();
    if (held && thumb) seek((duration * (event.clientX - box.left)) / box.width);
  };
  tracks.addEventListener("pointerdown", (event) => {
    held = event.target.closest(".row") !== null;
    if (held) tracks.setPointerCapture(event.pointerId);
    drag(event);
  });
  tracks.addEventListener("pointermove", drag);
  tracks.addEventListener("pointerup", () => (held = false));
})();
