// The page of an exported model: choose a robot and a start, and drive.

import { Controls, cap, fill, note, showMeter } from "./controls.js";
import { Table, paint } from "./family.js";
import { Loader, Session, World, fetchRuntime, openReplays, readManifest, startRuntime } from "./world.js";

const $ = (id) => document.getElementById(id);
const asked = new URLSearchParams(location.search);
let manifest, ort, model, backend, robot, world = null, start = 0;
let paused = true, begun = false, wanted = 0, made = 0, frame = 0, times = [], due = 0, opening = 0;  // frames computed, and shown
let replays = null, replaying = false;  // recorded actions and true images from each start, and whether they are followed
let canvas = null, table = null;  // the background of the robot's simulator, and its state; null without one
let making = Promise.resolve(), showing = Promise.resolve();  // a frame at a time, and the image of the one before
const loader = new Loader((done, total) => {
  $("bar").max = Math.max(total, done); $("bar").value = done;
  $("veil-text").textContent = `Loading: ${(done / 1e6).toFixed(1)} MB`;
});

const controls = new Controls({ stage: $("stage"), knob: $("knob"), card: $("drive") }, {
  paused: () => paused, replays: () => replaying, begun: () => begun, blocked: () => $("about").open || !world,
  takeOver: () => { follow(false); if (world && !begun && paused) run(true); },
  drive: () => {},
  buttons: { p: "run", n: "step", r: "reset", c: "scene", v: "replay" },
});

// -- loading

async function main() {
  if (await isolate()) return;  // it loads again
  manifest = await readManifest();
  await prune();
  document.title = $("model").textContent = manifest.model;
  $("robot").replaceChildren(...manifest.robots.map((one) => new Option(one.id + (one.about && " — " + one.about) + (one.holds && " · " + one.holds), one.id)));
  $("temperature-row").hidden = manifest.temperature === null;
  if (manifest.temperature !== null) {
    $("temperature").value = manifest.temperature;
    $("temperature").oninput();
  }
  const asks = asked.get("backend"), gpu = asks !== "wasm" && await hasGpu(asks === "webgpu");
  const named = manifest.robots.find((one) => one.id === asked.get("robot"));
  robot = named || manifest.robots[0];
  await poster();
  const { onWasm, onGpu, threads } = await runtimeOf(gpu);
  backend = gpu && asks === "webgpu" ? "webgpu" : "wasm";
  model = backend === "webgpu" ? await onGpu() : await onWasm();
  await openRobot();
  if (gpu && backend === "wasm") await tryGpu(onGpu);
  document.body.dataset.backend = backend;
  $("backend").textContent = backend === "webgpu" ? "WebGPU" : `WASM, ${threads} threads`;
  loop();
}

async function runtimeOf(gpu) {  // how the model's two graphs are opened: that of the next frame, and that of its image
  const { page } = manifest, step = loader.part(page.step), image = loader.part(page.image);
  for (const graph of [step, image]) graph.catch(() => {});  // they are awaited below
  const files = await fetchRuntime(manifest, loader, gpu ? "webgpu" : "wasm");
  const cores = crossOriginIsolated ? Number(asked.get("threads")) || Math.min(4, navigator.hardwareConcurrency || 1) : 1;
  const images = Math.max(1, cores >> 1), steps = Math.max(1, cores - images);  // threads
  ort = await startRuntime(files, 1);
  const open = async (image, ...providers) => {
    const sessions = [[step, steps], [image, images]].map(async ([graph, count]) => Session.open(files, await graph, count, ...providers));
    try {
      const [first, second] = await Promise.all(sessions);
      return { step: first, decoder: second };
    } catch (fault) {
      for (const one of sessions) one.then((session) => session.close(), () => {});
      throw fault;
    }
  };
  const onWasm = () => open(image, "wasm"), onGpu = () => open(loader.part(page.gpu_image), "webgpu", "wasm");
  return { onWasm, onGpu, threads: steps + images };
}

async function tryGpu(open) {  // a driver may compute wrongly, and the processor may be faster
  const held = [...document.querySelectorAll("button, select")].filter((one) => !one.disabled);
  for (const one of held) one.disabled = true;  // a session makes one frame at a time
  try {
    const found = await open();
    const better = await world.better(found), slower = better ? model : found;
    for (const one of Object.values(slower)) one.close();
    if (better) { model = world.model = found; backend = "webgpu"; await world.begin(start); }
  } catch { /* it stays on WebAssembly */ }
  for (const one of held) one.disabled = false;
}

async function isolate() {  // a service worker keeps files for offline use; loaded once more, the page may use threads
  if (!("serviceWorker" in navigator)) return false;
  try {
    await navigator.serviceWorker.register("sw.js");
    await Promise.race([navigator.serviceWorker.ready, new Promise((done) => setTimeout(done, 4000))]);
  } catch { return false; }
  if (navigator.serviceWorker.controller && crossOriginIsolated || sessionStorage.getItem("isolated")) return false;
  sessionStorage.setItem("isolated", "1");
  location.reload();
  return true;
}

async function prune() {  // forget the files of an older export here; other pages of this host keep theirs
  if (!self.caches) return;
  const versions = new Set([manifest.runtime.version, ...[...Object.values(manifest.page), ...manifest.robots.flatMap((one) => [one.stem, ...(one.replays ? one.replays.strips : [])])].map((part) => part.sha256.slice(0, 12))]);
  const cache = await caches.open("hma-export"), folder = new URL(".", location).href;
  for (const request of await cache.keys()) {
    const version = new URL(request.url).searchParams.get("v");
    const own = request.url.startsWith(folder) && /^(page-|robots\/|ort\/)/.test(request.url.slice(folder.length));
    if (own && version && !versions.has(version)) await cache.delete(request);
  }
}

async function hasGpu(emulated) {  // one that the processor emulates is slow
  try {
    const found = navigator.gpu && await navigator.gpu.requestAdapter();
    return Boolean(found) && (emulated || !(found.info && found.info.isFallbackAdapter || found.isFallbackAdapter));
  } catch { return false; }
}

async function loadImage(url) {  // null if there is none
  if (!url) return null;
  const image = new Image();
  image.src = url;
  await image.decode().catch(() => {});
  return image.width ? image : null;
}

async function poster() {  // show the start at once
  const image = await loadImage(robot.pictures[start]);
  if (image) { size(image.width, image.height); $("view").getContext("2d").drawImage(image, 0, 0); }
}

async function openRobot() {
  const turn = ++opening;
  world = null; run(false);
  $("replay").hidden = true;
  veil("Loading …");
  $("robot").value = robot.id;
  start = 0;
  await making;
  await showing;
  const [opened, background] = await Promise.all([World.open(ort, manifest, robot, loader, model), loadImage(robot.simulator && robot.simulator.canvas)]);
  if (turn !== opening) return;  // another robot was chosen meanwhile
  opened.temperature = manifest.temperature === null ? null : Number($("temperature").value);
  world = opened;
  replays = null;
  canvas = background;
  $("scene").hidden = robot.pictures.length < 2;
  if (robot.simulator && !canvas) note(robot.simulator.canvas + " cannot be loaded, so the true simulator is not shown: copy the exported folder again", 9000);
  else if (!robot.follows) note(robot.id + " does not follow its actions in this model: drive another robot to see it answer.", 9000);
  await begin(0);
  const found = await openReplays(robot, loader).catch(() => null);  // the page drives without them too
  if (turn !== opening) return;
  replays = found;
  $("replay").hidden = !replays;
}

async function begin(number) {
  start = number;
  run(false);
  begun = false; wanted = 0;
  follow(false);
  if (!robot.simulator) showTruth(false);
  const ready = making.then(restart);  // no frame is made meanwhile, and no other start begins
  making = ready.catch(() => {});
  await ready;
}

async function restart() {
  await showing;
  const current = world;
  made = frame = 0;
  await poster();
  if (current) await current.begin(start);
  if (!current || current !== world) return;  // another robot was chosen meanwhile
  table = canvas && new Table(robot.simulator.body, robot.simulator.tables[start]);
  showTruth(Boolean(table));
  if (table) drawTruth(table.shapes());
  controls.open(robot, robot.held[start]);
  metered();
  counted();
  showStart();
  veil("");
}

// -- frames

async function loop() {
  for (;;) {
    await making;  // a start that begins
    const now = performance.now();
    const ended = replaying && made === replays[start].chunks.length;  // its last image is still to come
    if (world && (wanted > 0 || !paused) && !ended && now >= due) {
      making = make().catch(fail);
      await making;
    }
    await pause(world && !paused ? Math.min(due - performance.now(), 20) : 20);
  }
}

// Timers of a page wait 4 ms or more; a message does not.
const channel = new MessageChannel();
function pause(ms) {
  return new Promise((done) => {
    if (ms > 4) return setTimeout(done, ms);
    channel.port1.onmessage = done;
    channel.port2.postMessage(0);
  });
}

async function make() {
  controls.look();
  const current = world, followed = replaying, action = controls.action.length ? controls.action : controls.targets, number = controls.input;
  const chunk = followed ? [...replays[start].chunks[made]] : Array.from({ length: robot.stride }, () => action).flat();
  const begunAt = performance.now(), period = 1000 * robot.stride / robot.hz;
  await current.advance(chunk);
  if (current !== world) return;
  wanted = Math.max(0, wanted - 1);
  const now = performance.now();
  due = $("fast").checked ? now : Math.max(due + period, now);
  begun = true;
  made += 1;
  const width = robot.dimensions.length;
  if (table) for (let i = 0; i < robot.stride; i++) table.advance(chunk.slice(i * width, (i + 1) * width));
  const shapes = table && table.shapes(), error = current.metered(robot.meter);
  await showing;
  if (current === world) showing = show(current, current.image(), { number, chunk, followed, shapes, error, begunAt }).catch(fail);
}

async function show(current, made, { number, chunk, followed, shapes, error, begunAt }) {  // while the next frame is computed
  const image = await made;
  if (current !== world) return;
  const now = performance.now();
  frame += 1;
  draw(image);
  metered(error);
  controls.used(number);
  if (followed && replaying) controls.follow(chunk.slice(-robot.dimensions.length));
  followed || shapes ? drawTruth(shapes) : $("unknown").hidden = false;
  times = [...times.filter((time) => now - time < 4000), now];
  $("fps").textContent = times.length > 1 ? (1000 * (times.length - 1) / (now - times[0])).toFixed(1) : "–";
  $("fps").title = `The model took ${(now - begunAt).toFixed(0)} ms`;
  if (followed && replaying && frame === replays[start].chunks.length) { follow(false); run(false); }
  counted();
  document.dispatchEvent(new CustomEvent("frame", { detail: { number: frame, chunk, image, ms: now - begunAt } }));
}

function metered(found = world.metered(robot.meter)) {
  const { meter, unmetered } = robot;
  const other = meter && !found && `uncertainty is calibrated only for temperature ${meter.temperature}: set it, and press Reset`;
  showMeter(found, other || (meter ? meter.verdict : unmetered), "no error meter");
}

function size(width, height) { const view = $("view"); if (view.width !== width || view.height !== height) { view.width = width; view.height = height; } }

function draw(rgb) {
  const [height, width] = manifest.image, pixels = new Uint8ClampedArray(4 * width * height).fill(255);
  for (let i = 0, j = 0; i < rgb.length; i += 3, j += 4) { pixels[j] = rgb[i]; pixels[j + 1] = rgb[i + 1]; pixels[j + 2] = rgb[i + 2]; }
  size(width, height);
  $("view").getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
}

// -- what truly happened

function follow(on) {
  if (replaying && !on) controls.sentText = "";  // the action is a person's again
  replaying = on;
  $("replay").setAttribute("aria-pressed", on);
}

function showTruth(on) { $("true-figure").hidden = !on; $("left").classList.toggle("two", on); $("unknown").hidden = true; }

function drawTruth(shapes) {
  const view = $("true-view");
  if (shapes) {
    [view.height, view.width] = manifest.image;
    return paint(view, canvas, shapes);
  }
  const { strip, columns, chunks } = replays[start];
  view.width = strip.width / columns;
  view.height = strip.height / Math.ceil((chunks.length + 1) / columns);
  view.getContext("2d").drawImage(strip, -(frame % columns) * view.width, -Math.floor(frame / columns) * view.height);
}

async function replay() {
  if (replaying) return follow(false);
  const turn = opening;
  await begin(start);
  if (turn !== opening || !replays) return;  // another robot was chosen meanwhile
  if (!table) { showTruth(true); drawTruth(); }
  follow(true);
  run(true);
}

function counted() {
  $("clock").textContent = (frame * robot.stride / robot.hz).toFixed(1) + " s";
  document.body.dataset.frame = frame;
}

function run(on) {
  paused = !on;
  if (on) begun = true;
  times = []; due = performance.now();
  if (paused) { controls.forget(); $("fps").textContent = "–"; }
  $("run").firstChild.textContent = paused ? "Run " : "Pause ";
  showStart();
}

// -- what is said

function showStart() {
  const hint = $("start"), touch = matchMedia("(pointer: coarse)").matches;
  hint.hidden = !paused || !world;
  if (hint.hidden) return;
  if (frame) return hint.replaceChildren(touch ? "Paused: tap Run" : "Paused: Run or P continues");
  if (touch) return hint.replaceChildren("Drag here to drive");
  hint.replaceChildren(...robot.keys.flat().slice(0, 4).map(cap), robot.pads.length ? " or drag here to drive" : " drive");
}

function veil(text, again = false) {
  $("veil").hidden = !text;
  $("veil-text").textContent = text;
  $("again").hidden = !again;
  $("bar").hidden = again;
}

function fail(fault) {
  world = null; paused = true;
  loader.show = () => {};  // other downloads go on, and must not cover what is said
  veil(fault.message || String(fault), true);
}

// -- buttons

$("robot").onchange = () => { robot = manifest.robots.find((one) => one.id === $("robot").value); openRobot().catch(fail); };
$("run").onclick = () => { if (world) run(paused); };
$("step").onclick = () => { if (world) { run(false); wanted += 1; } };
$("reset").onclick = () => { if (world) begin(start).catch(fail); };
$("scene").onclick = () => { if (world) begin((start + 1) % robot.pictures.length).catch(fail); };
$("replay").onclick = () => { if (world && replays) replay().catch(fail); };
$("again").onclick = () => location.reload();
$("temperature").oninput = () => {
  $("temperature-out").value = $("temperature").value;
  fill($("temperature"), 0);
  if (world) world.temperature = Number($("temperature").value);
};
fill($("temperature"), 0);
main().catch(fail);
