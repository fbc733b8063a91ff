// Drive a robot by keys, mouse, touch, sliders and a gamepad. The page of `hma play` and the exported page share it.
//
//   const controls = new Controls({ stage, knob, card }, host);   // fills the card
//   controls.open(robot, held);      // robot as hma_model.play.pads describes it; the action it begins with
//   controls.look();                 // before a frame: the action of this moment
//   controls.used(number);           // a frame was made by the action of that number
//
// The host says how things stand, and is told what a person does:
//   paused(), replays(), begun()     whether the clock stands, recorded actions are followed, something was driven
//   blocked()                        whether keys do nothing
//   takeOver()                       a person begins to drive
//   drive(action, number)            the action from now on
//   buttons                          key -> id of the button that it presses
//
// Both pages have the elements note, meter, help, about, close and left, which are served here too.

const CARD = `
  <header><h2>Drive</h2><span class="hint" id="rate"></span></header>
  <p class="hint" id="hint"></p>
  <div class="dims" id="dims"></div>`;
const NAMES = { ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓", " ": "Space" };

export function clamp(value, low, high) { return Math.min(Math.max(value, low), high); }

export function cap(key) {
  const made = document.createElement("kbd");
  made.textContent = NAMES[key] || key.toUpperCase();
  made.dataset.key = key;
  return made;
}

export function fill(slider, origin) {  // colours a slider from the origin to its value
  const share = (value) => 100 * (value - slider.min) / (slider.max - slider.min);
  const ends = [share(origin), share(slider.value)].sort((a, b) => a - b);
  slider.style.setProperty("--from", ends[0] + "%"); slider.style.setProperty("--to", ends[1] + "%");
}

let noteTimer = 0;
export function note(text, stay = 4500) {  // says something for a while; with 0 it stays
  const place = document.getElementById("note");
  clearTimeout(noteTimer);
  place.textContent = text; place.hidden = !text;
  if (text && stay) noteTimer = setTimeout(() => note(""), stay);
}

export function showMeter(found, title, absent) {  // the error that the model expects of itself
  const warns = Boolean(found && found.warns), meter = document.getElementById("meter");
  for (const place of [meter, document.getElementById("stage")]) place.classList.toggle("warns", warns);
  const error = found && `error ${found.beyond ? ">" : "≈"} ${found.px.toFixed(1)} px`;
  meter.textContent = found ? (warns ? "unsure: " : "") + error : absent;
  meter.title = title;
}

function shape(name, values) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(values)) made.setAttribute(key, value);
  return made;
}

function gamepads() { return [...(navigator.getGamepads ? navigator.getGamepads() : [])].filter(Boolean); }

const bare = (event) => event.key.length === 1 ? event.key.toLowerCase() : event.key;
const typing = (element) => element && element.matches("select, input, textarea");

export class Controls {
  constructor({ stage, knob, card }, host) {
    card.innerHTML = CARD;
    const [rate, hint, dims] = ["rate", "hint", "dims"].map((id) => card.querySelector("#" + id));
    Object.assign(this, { stage, knob, rate, hint, dims }, { host, robot: null, targets: [], action: [], pushed: [], sticks: [], input: 0, sentText: "" });
    this.pressed = new Set(); this.fresh = new Set();
    this.latched = new Map();  // key that was let go -> input that a frame must have had
    this.sentAt = new Map();  // input that no frame has had yet -> when it was sent
    this.grips = new Map();  // pointer -> where it drags
    this.before = performance.now(); this.padButton = false;
    this.listen();
    requestAnimationFrame(() => this.tick());
  }

  open(robot, held) {
    const same = this.robot && this.robot.key === robot.key;
    this.robot = robot;
    this.pressed.clear(); this.latched.clear(); this.sentAt.clear(); this.grips.clear();
    this.sentText = "";
    this.targets = held.slice(); this.action = [];
    this.rate.textContent = `${+robot.hz.toPrecision(3)} actions/s, ${robot.stride} a frame`;
    if (!same) this.build();
    this.pushed = robot.dimensions.map(() => 0);
    this.drawKnob();
  }

  follow(action) { this.action = action; this.targets = action.slice(); this.showAction(); this.drawKnob(); }

  used(number) {  // returns how many milliseconds ago that action was sent; null if that is not known
    const sent = this.sentAt.get(number);
    if (sent !== undefined) for (const one of [...this.sentAt.keys()]) if (one <= number) this.sentAt.delete(one);
    for (const [key, needed] of [...this.latched]) if (number >= needed) this.latched.delete(key);
    return sent === undefined ? null : performance.now() - sent;
  }

  forget() { this.latched.clear(); this.sentAt.clear(); }

  // -- sliders and switches

  build() {
    this.sticks = this.buildSticks();
    this.dims.replaceChildren(...this.robot.dimensions.map((dim, i) => this.dimRow(dim, i)));
    this.stage.classList.toggle("pad", this.robot.pads.length > 0);
    const touch = matchMedia("(pointer: coarse)").matches;
    this.hint.textContent = this.robot.hint + (touch ? "; or use the sliders." : "; or use the keys (Shift: slower), the sliders, or a gamepad.");
  }

  buildSticks() {  // value -> axis of a gamepad, and its sign: a stick for each of the two leftmost pads
    const found = [], free = new Set([0, 1, 2, 3]);
    const give = (i, axis, sign) => { if (i !== null && i !== undefined && free.delete(axis)) found[i] = { axis, sign }; };
    const leftmost = [...this.robot.pads].sort((one, other) => one.zone[0] - other.zone[0]).slice(0, 2);
    leftmost.forEach((pad, k) => { give(pad.x, 2 * k, pad.flips[0] ? -1 : 1); give(pad.y, 2 * k + 1, pad.flips[1] ? -1 : 1); });
    this.robot.dimensions.forEach((dim, i) => {
      if (dim.kind !== "switch" && !found[i] && free.size) { const axis = Math.min(...free); give(i, axis, axis % 2 ? -1 : 1); }
    });
    return found;
  }

  dimRow(dim, i) {
    const row = document.createElement("div");
    row.className = "dim";
    const name = document.createElement("label"), value = document.createElement("output"), track = document.createElement("div");
    name.textContent = dim.label; name.title = dim.name; name.htmlFor = "dim-" + i;
    value.id = "value-" + i; value.htmlFor = "dim-" + i;
    track.className = "track";
    const caps = this.robot.keys[i].map(cap);
    if (dim.kind === "switch") {
      const button = document.createElement("button");
      button.id = "dim-" + i; button.append("Switch ", ...caps);
      button.onclick = () => this.toggle(i);
      track.append(button);
    } else {
      track.append(...caps.slice(0, 1), this.slider(dim, i), ...caps.slice(1));
    }
    row.append(name, value, track);
    return row;
  }

  slider(dim, i) {
    const slider = document.createElement("input");
    slider.type = "range"; slider.id = "dim-" + i; slider.min = dim.low; slider.max = dim.high; slider.step = "any";
    slider.oninput = () => { this.host.takeOver(); (dim.kind === "rate" ? this.pushed : this.targets)[i] = Number(slider.value); };
    if (dim.kind === "rate") for (const end of ["pointerup", "pointercancel", "touchend", "blur", "keyup"]) slider.addEventListener(end, () => { this.pushed[i] = 0; });
    slider.addEventListener("keydown", (event) => {
      if (!event.key.startsWith("Arrow")) return;
      event.preventDefault();
      this.host.takeOver();
      const sign = event.key === "ArrowRight" || event.key === "ArrowUp" ? 1 : -1, span = dim.high - dim.low;
      if (dim.kind === "rate") this.pushed[i] = sign > 0 ? dim.high : dim.low;
      else this.targets[i] = clamp(this.targets[i] + sign * span / 40, dim.low, dim.high);
    });
    return slider;
  }

  toggle(i) {
    this.host.takeOver();
    const dim = this.robot.dimensions[i];
    this.targets[i] = this.targets[i] > (dim.low + dim.high) / 2 ? dim.low : dim.high;
  }

  showAction() {
    this.robot.dimensions.forEach((dim, i) => {
      const control = document.getElementById("dim-" + i), shown = document.getElementById("value-" + i), value = this.action[i];
      if (dim.kind === "switch") { const on = value > 0.5; control.setAttribute("aria-pressed", on); shown.value = on ? "1" : "0"; return; }
      control.value = value;
      fill(control, dim.kind === "rate" ? 0 : dim.low);
      const places = clamp(2 - Math.floor(Math.log10(Math.max(Math.abs(dim.low), Math.abs(dim.high), 1e-9))), 0, 9);
      shown.value = value.toFixed(places).replace(/^-(0\.?0*)$/, "$1") + (dim.unit ? " " + dim.unit : "");
    });
  }

  // -- the action of the moment

  tick() {
    this.look();
    requestAnimationFrame(() => this.tick());
  }

  look() {  // a model that computes without a pause leaves the browser few animation frames
    const now = performance.now(), passed = Math.min(now - this.before, 100) / 1000;
    this.before = now;
    const tilted = () => gamepads().some((one) => one.axes.some((axis) => Math.abs(axis) > 0.2));
    if (this.robot && (!this.host.replays() || tilted())) this.drive(passed);
  }

  drive(passed) {
    const { pressed, latched, targets, host } = this;
    const fine = pressed.has("Shift") ? 0.33 : 1, gamepad = gamepads()[0];
    this.action = this.robot.dimensions.map((dim, i) => {
      const [down, up] = this.robot.keys[i], stick = this.sticks[i];
      const held = (key) => key && (pressed.has(key) || latched.has(key)) ? fine : 0;
      let way = dim.kind === "switch" ? 0 : held(up) - held(down);
      const tilt = gamepad && stick ? gamepad.axes[stick.axis] || 0 : 0;
      if (Math.abs(tilt) > 0.15) {
        way = tilt * stick.sign;
        if (host.replays() || !host.begun()) host.takeOver();
      }
      if (dim.kind === "rate") return clamp(way * dim.high + this.pushed[i] + this.dragged(i), dim.low, dim.high);
      if (way && !host.paused()) targets[i] = clamp(targets[i] + way * (dim.high - dim.low) / 2.5 * passed, dim.low, dim.high);
      return targets[i];
    });
    this.fresh.clear();
    const button = Boolean(gamepad && gamepad.buttons[0] && gamepad.buttons[0].pressed);
    if (button && !this.padButton) this.robot.dimensions.forEach((dim, i) => { if (dim.kind === "switch") this.toggle(i); });
    this.padButton = button;
    const text = this.action.map((value) => value.toPrecision(6)).join();
    if (text === this.sentText) return;
    this.sentText = text;
    this.input += 1;
    if (!host.paused()) this.sentAt.set(this.input, performance.now());
    host.drive(this.action, this.input);
    this.showAction();
    this.drawKnob();
  }

  dragged(i) { let sum = 0; for (const grip of this.grips.values()) sum += grip.rates[i] || 0; return sum; }

  // -- dragging on the image

  drawKnob() {
    const shapes = [], both = (make) => { for (const kind of ["dark", "light"]) shapes.push(...make(kind)); };
    for (const pad of this.robot.pads) {
      if (!pad.low) continue;
      const held = this.action.length ? this.action : this.targets;
      const share = (i, k) => i === null ? 50 * (pad.zone[k] + pad.zone[k + 2]) : 100 * (held[i] - pad.low[k]) / (pad.high[k] - pad.low[k]);
      const [cx, cy] = [share(pad.x, 0), share(pad.y, 1)];
      const arms = [[5, 0], [-5, 0], [0, 5], [0, -5]];
      both((kind) => [...arms.map(([dx, dy]) => shape("line", { x1: cx + dx * 0.45, y1: cy + dy * 0.45, x2: cx + dx, y2: cy + dy, class: kind })), shape("circle", { cx, cy, r: 3, class: kind })]);
    }
    for (const { pad, origin: [x1, y1], to: [x2, y2] } of this.grips.values())
      if (!pad.low) both((kind) => [shape("line", { x1, y1, x2, y2, class: kind }), shape("circle", { cx: x1, cy: y1, r: 1, class: kind }), shape("circle", { cx: x2, cy: y2, r: 3, class: kind })]);
    this.knob.replaceChildren(...shapes);
  }

  place(event) {
    const box = this.stage.getBoundingClientRect();
    return [100 * (event.clientX - box.left) / box.width, 100 * (event.clientY - box.top) / box.height];
  }

  grip(event) {
    if (!this.robot || !this.robot.pads.length || event.button || event.target.closest(".veil")) return;
    event.preventDefault();
    this.stage.focus({ preventScroll: true, focusVisible: false });
    this.stage.setPointerCapture(event.pointerId);
    this.host.takeOver();
    const at = this.place(event);
    const inside = ({ zone }) => at[0] >= 100 * zone[0] && at[0] <= 100 * zone[2] && at[1] >= 100 * zone[1] && at[1] <= 100 * zone[3];
    const grip = { pad: this.robot.pads.find(inside) || this.robot.pads[0], origin: at, to: at, start: this.targets.slice(), rates: [], free: false };
    this.grips.set(event.pointerId, grip);
    this.steer(grip, at);
  }

  letGo(pointer) {  // a short push still moves the robot for one frame
    const grip = this.grips.get(pointer), number = this.input;
    if (!grip || grip.free) return;
    grip.free = true;
    const wait = () => {
      if (this.grips.get(pointer) !== grip) return;
      if (grip.rates.length && this.sentAt.has(number) && !this.host.paused()) return void setTimeout(wait, 30);
      this.grips.delete(pointer);
      this.drawKnob();
    };
    wait();
  }

  steer(grip, at) {
    const { pad, origin } = grip, most = 25;
    const values = [[pad.x, 0, pad.flips[0] ? -1 : 1], [pad.y, 1, pad.flips[1] ? -1 : 1]].filter(([i]) => i !== null);
    const way = [0, 0];
    for (const [, k] of values) way[k] = at[k] - origin[k];
    const length = Math.hypot(...way), scale = length > most ? most / length : 1;
    for (const [i, k, sign] of values) {
      const dim = this.robot.dimensions[i];
      if (pad.low) this.targets[i] = clamp(pad.low[k] + clamp(at[k], 0, 100) / 100 * (pad.high[k] - pad.low[k]), dim.low, dim.high);
      else if (dim.kind === "rate") grip.rates[i] = sign * way[k] * scale / most * dim.high;
      else this.targets[i] = clamp(grip.start[i] + sign * way[k] / 60 * (dim.high - dim.low), dim.low, dim.high);  // 60 % of the image: the whole range
    }
    grip.to = [origin[0] + way[0] * scale, origin[1] + way[1] * scale];
    this.drawKnob();
  }

  // -- events

  listen() {
    const { stage } = this;
    stage.addEventListener("pointerdown", (event) => this.grip(event));
    stage.addEventListener("pointermove", (event) => { const grip = this.grips.get(event.pointerId); if (grip && !grip.free) this.steer(grip, this.place(event)); });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) stage.addEventListener(end, (event) => this.letGo(event.pointerId));
    addEventListener("keydown", (event) => this.keyDown(event));
    addEventListener("keyup", (event) => this.keyUp(event));
    addEventListener("blur", () => this.release());
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.release(); });
    // A setting that was clicked does not keep the keys for itself.
    let clicked = false;
    addEventListener("pointerdown", () => { clicked = true; }, true);
    addEventListener("keydown", () => { clicked = false; }, true);
    addEventListener("change", () => { if (clicked) stage.focus({ preventScroll: true, focusVisible: false }); });
    const [help, close, about, left] = ["help", "close", "about", "left"].map((id) => document.getElementById(id));
    help.onclick = () => { this.release(); about.showModal(); about.scrollTop = 0; };
    close.onclick = () => { about.close(); stage.focus({ preventScroll: true, focusVisible: false }); };
    about.onclick = (event) => { if (event.target === about) about.close(); };  // beside it
    for (const radio of document.querySelectorAll("input[name=pixels]")) radio.onchange = () => left.classList.toggle("crisp", radio.value === "crisp");
  }

  keyDown(event) {
    const key = bare(event), inside = document.activeElement, button = this.host.buttons[key];
    if (key === "Shift") this.pressed.add(key);
    if (event.ctrlKey || event.metaKey || event.altKey || !this.robot || this.host.blocked()) return;
    if (key === "?") return document.getElementById("help").click();
    if (key === "Escape") { if (typing(inside)) this.stage.focus(); return; }
    if (typing(inside) && (key.startsWith("Arrow") || inside.matches("select") || key === " ")) return;
    if (key === " " && inside && inside.matches("button")) return;
    const dim = this.robot.keys.findIndex((pair) => pair.includes(key));
    if (dim >= 0) {
      event.preventDefault();
      if (event.repeat) return;
      this.host.takeOver();
      this.light(key, true);
      if (key === " ") return this.toggle(dim);
      this.pressed.add(key);
      this.fresh.add(key);
    } else if (button && !event.repeat && !document.getElementById(button).hidden) {
      event.preventDefault();
      document.getElementById(button).click();
    }
  }

  keyUp(event) {
    const key = bare(event);
    if (this.pressed.delete(key) && key !== "Shift" && !this.host.paused())
      if (this.fresh.has(key) || this.sentAt.has(this.input)) this.latched.set(key, this.fresh.has(key) ? this.input + 1 : this.input);  // not yet in a frame
    this.light(key, false);
  }

  release() {
    this.pressed.clear(); this.latched.clear();
    for (const lit of document.querySelectorAll("kbd.down")) lit.classList.remove("down");
  }

  light(key, on) { for (const lit of this.dims.querySelectorAll("kbd")) if (lit.dataset.key === key) lit.classList.toggle("down", on); }
}
