// Keeps the tracks below viser's recording in step with it. viser has no interface for its clock; the handle of its
// slider bears the time (aria-valuenow), and its number field takes one. "#t=2.5" in the address starts there, paused.
(() => {
  const root = document.getElementById("root");
  const tracks = document.getElementById("stmc-tracks");
  const duration = Number(document.body.dataset.duration);
  let thumb = null;

  function follow() {
    const time = Math.min(Number(thumb.getAttribute("aria-valuenow")), duration);
    document.body.dataset.time = time.toFixed(3);
    for (const element of document.querySelectorAll("[data-from]")) {
      const now = Number(element.dataset.from) <= time && time < Number(element.dataset.to);
      if (element.classList.contains("bar")) element.classList.toggle("now", now);
      else element.hidden = !now;
    }
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
    const found = root.querySelector("[role=slider]");
    if (!found || found === thumb) return;
    const first = thumb === null;
    thumb = found;
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
