// Elements made in a line, lists kept in step with values, and what a state change repaints.

export const find = (id) => document.getElementById(id);

// make("button", {class: "plain", onclick: f, "aria-label": "Play"}, "text", child, …); null children are left out.
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "value" || name === "checked") {
      element[name] = value;
      if (name === "value" && "defaultValue" in element) element.defaultValue = value; // for Escape to go back to
    }
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

// An icon of index.html; a pin for a name that has none.
export function icon(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("class", "icon");
  svg.setAttribute("aria-hidden", "true");
  const use = document.createElementNS("http://www.w3.org/2000/svg", "use");
  use.setAttribute("href", `#icon-${find(`icon-${name}`) ? name : "pin"}`);
  svg.append(use);
  return svg;
}

export const button = (text, onclick, attributes = {}, name = null) =>
  make("button", { type: "button", onclick, ...attributes }, name && icon(name), text && make("span", {}, text));

// The colours of the room, as the page's style has them.
export function roomStyle() {
  const style = getComputedStyle(document.documentElement);
  const value = (name) => style.getPropertyValue(name).trim();
  return { room: value("--room"), line: value("--floor"), way: value("--way"), shadow: Number(value("--shadow")) };
}

// Children of `parent`, one for each item, kept by key: made by `create(item)`, brought up to date by `update(element, item)`.
export function keyed(parent, items, keyOf, create, update) {
  const old = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  items.forEach((item, index) => {
    const key = String(keyOf(item));
    let element = old.get(key);
    if (!element) {
      element = create(item);
      element.dataset.key = key;
    }
    old.delete(key);
    if (parent.children[index] !== element) parent.insertBefore(element, parent.children[index] ?? null);
    update(element, item);
  });
  for (const gone of old.values()) gone.remove();
}

// New content for a panel; what is being typed in it, and where, stays.
export function fill(panel, ...children) {
  const active = panel.contains(document.activeElement) ? document.activeElement : null;
  const key = active?.dataset.key;
  const typed = key && "value" in active && active.type !== "checkbox" ? active.value : null;
  const typing = typed !== null && active.defaultValue !== typed;
  panel.replaceChildren(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  if (!key) return;
  const again = panel.querySelector(`[data-key="${CSS.escape(key)}"]`);
  again?.focus({ preventScroll: true });
  if (again && typing && again.type !== "button") again.value = typed;
}

// Calls `paint(state)` now, and whenever one of the values that `pick(state)` lists is another one.
export function watch(store, pick, paint) {
  let before = null;
  const look = (state) => {
    const values = pick(state);
    if (before && values.every((value, index) => Object.is(value, before[index]))) return;
    before = values;
    paint(state);
  };
  store.subscribe(look);
  look(store.get());
}

// A sentence that is read out, and not seen.
export const tell = (sentence) => (find("told").textContent = sentence);

let waiting = null;
// A sentence that stands for a while, and is read out; with a button where there is something to do about it.
export function say(sentence, label = null, act = null) {
  const place = find("message");
  clearTimeout(waiting);
  place.replaceChildren(make("span", {}, sentence), ...(label ? [button(label, () => { place.hidden = true; act(); })] : []));
  place.hidden = false;
  waiting = setTimeout(() => (place.hidden = true), label ? 9000 : 5000);
}
