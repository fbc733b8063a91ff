// Run an exported model in this browser: load the runtime and the graphs, and make frame after frame.

const POWER = 4;  // of the uncertainty, as hma_model.evaluation.calibration sums it
const TYPES = { int32: Int32Array, float32: Float32Array };
const BUILDS = {
  webgpu: ["ort.webgpu.min.mjs", "ort-wasm-simd-threaded.asyncify"],
  wasm: ["ort.wasm.min.mjs", "ort-wasm-simd-threaded"],
};
// The smallest module with an instruction of 128 bits: a browser that refuses it has no SIMD.
const SIMD = [0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1, 8, 0, 65, 0, 253, 15, 253, 98, 11];

export class Loader {  // downloads, and says how many bytes there are
  constructor(show) { this.show = show; this.done = 0; this.total = 0; }

  async bytes(url, { size = 0, sha256 = "", integrity = "" } = {}) {
    this.total += size;
    let answer;
    try { answer = await fetch(url, integrity ? { integrity } : {}); }
    catch (fault) { throw new Error(`${named(url)} cannot be loaded${integrity ? ", or is not the file that it should be" : ""}: ${fault.message}`); }
    if (!answer.ok) throw new Error(`${named(url)} cannot be loaded: the host answers ${answer.status}`);
    const parts = [], reader = answer.body.getReader();
    for (;;) {
      let step;
      try { step = await reader.read(); }
      catch (fault) { throw new Error(`${named(url)} was cut off: ${fault.message}`); }
      if (step.done) break;
      parts.push(step.value);
      this.done += step.value.length;
      this.show(this.done, this.total);
    }
    const content = new Uint8Array(await new Blob(parts).arrayBuffer());
    let fault = size && content.length !== size ? `has ${content.length} bytes instead of ${size}` : "";
    if (!fault && sha256 && crypto.subtle && await digest(content) !== sha256) fault = "is damaged";
    if (!fault) return content;
    if (self.caches) await (await caches.open("hma-export")).delete(new URL(url, location));  // do not keep it
    throw new Error(`${named(url)} ${fault}: copy the exported folder again`);
  }

  part(part) { return this.bytes(`${part.file}?v=${part.sha256.slice(0, 12)}`, { size: part.bytes, sha256: part.sha256 }); }
}

function named(url) { return String(url).split("?")[0]; }

async function digest(content) {
  const found = new Uint8Array(await crypto.subtle.digest("SHA-256", content));
  return [...found].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

export async function readManifest() {
  let answer;
  try { answer = await fetch("manifest.json", { cache: "no-cache" }); }
  catch { throw new Error("manifest.json cannot be loaded: is the host reachable?"); }
  if (!answer.ok) throw new Error("manifest.json is missing here: copy the page into a folder that hma export made");
  const manifest = await answer.json().catch(() => ({}));
  if (manifest.format !== "hma-export" || manifest.format_version !== 1 || !manifest.page) throw new Error("manifest.json is of another version of hma export: export again");
  return manifest;
}

export function fetchRuntime(manifest, loader, backend) {  // the files of ONNX Runtime Web
  if (!WebAssembly.validate(new Uint8Array(SIMD))) throw new Error("This browser has no WebAssembly with SIMD: use one of 2021 or later (Safari 16.4)");
  const [library, engine] = BUILDS[backend], { base, files, version } = manifest.runtime;
  const load = (name) => loader.bytes(`${base}${name}?v=${version}`, { integrity: files[name] });
  return Promise.all([load(library), load(`${engine}.mjs`), load(`${engine}.wasm`)]);
}

export async function startRuntime([script, glue, binary], threads) {
  const address = (content) => URL.createObjectURL(new Blob([content], { type: "text/javascript" }));
  const ort = await import(address(script));
  ort.env.wasm.wasmPaths = { mjs: address(glue) };
  ort.env.wasm.wasmBinary = binary;
  ort.env.wasm.numThreads = threads;
  ort.env.logLevel = "error";
  return ort;
}

export async function readNumbers(url, loader) {  // a .npy file: its numbers and their shape
  const content = await loader.bytes(url);
  const size = content[8] + 256 * content[9];
  const header = new TextDecoder().decode(content.subarray(10, 10 + size));
  const kind = { "<i4": Int32Array, "<f4": Float32Array, "|u1": Uint8Array }[/'descr': '([^']+)'/.exec(header)[1]];
  return { values: new kind(content.buffer, 10 + size), shape: /'shape': \(([^)]*)\)/.exec(header)[1].split(",").filter((one) => one.trim()).map(Number) };
}

export async function openReplays(robot, loader) {  // recorded actions from each start, and perhaps the true images in one picture
  if (!robot.replays) return null;
  const { strips, columns } = robot.replays, [numbers, ...parts] = await Promise.all([readNumbers(robot.replays.chunks, loader), ...strips.map((one) => loader.part(one))]);
  const [, count, width] = numbers.shape, chunks = rows(numbers, width);
  const images = await Promise.all(parts.map((part) => createImageBitmap(new Blob([part], { type: "image/webp" }))));
  return robot.pictures.map((_, i) => ({ strip: images[i], columns, chunks: chunks.slice(i * count, (i + 1) * count) }));
}

function rows({ values, shape }, size) {  // the numbers of each place of the first axes
  return Array.from({ length: values.length / size }, (_, i) => values.slice(i * size, (i + 1) * size));
}

const numbers = ({ dtype, shape }, data = new TYPES[dtype](product(shape))) => ({ type: dtype, data, dims: shape });

const product = (shape) => shape.reduce((one, other) => one * other, 1);

function normal() { return Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random()); }

export class Session {  // a graph in a worker: the page stays free, and two graphs run side by side
  constructor() {
    this.worker = new Worker(new URL("session.js", import.meta.url), { type: "module" });
  }

  static async open(runtime, graph, threads, ...providers) {
    const opened = new Session();
    try { await opened.ask({ runtime, graph, threads, providers }); }
    catch (fault) { opened.close(); throw fault; }
    return opened;
  }

  ask(message) {  // one question at a time
    return new Promise((done, failed) => {
      this.worker.onmessage = ({ data: { fault, made } }) => fault ? failed(new Error(fault)) : done(made);
      this.worker.onerror = () => failed(new Error("session.js cannot be loaded: copy the exported folder again, or use a browser of 2023 or later"));
      this.worker.postMessage(message);
    });
  }

  run(inputs, give, keep = []) { return this.ask({ inputs, give, keep }); }  // `keep` names what the next run takes of this one

  close() { this.worker.terminate(); }
}

export class World {  // one robot
  static async open(ort, manifest, robot, loader, model) {
    const [graph, frames, chunks] = await Promise.all([loader.part(robot.stem), readNumbers(robot.frames, loader), readNumbers(robot.chunks, loader)]);
    const stem = await ort.InferenceSession.create(graph, { executionProviders: ["wasm"] });  // too small for a GPU
    return new World(ort, manifest, stem, model, frames, chunks);
  }

  constructor(ort, manifest, stem, model, frames, chunks) {
    Object.assign(this, { ort, manifest, stem, model, temperature: manifest.temperature, unsure: 0 });
    const [starts, known] = frames.shape;
    this.width = chunks.shape[2];
    this.frames = rows(frames, frames.values.length / starts / known);
    this.chunks = rows(chunks, this.width);
    this.known = known;
  }

  async begin(start) {  // give the model the known frames of a start
    this.before = new Float32Array(this.width).fill(NaN);
    this.given = this.nothing();
    for (let i = 0; i < this.known; i++) {
      this.put(this.frames[start * this.known + i]);
      if (i < this.known - 1) await this.advance(this.chunks[start * (this.known - 1) + i]);
    }
    this.unsure = 0;
  }

  metered(meter) {  // the state error to expect, and whether to warn; null if the frames are not all of the calibrated kind
    if (!meter || !Number.isFinite(this.unsure)) return null;
    const stated = this.unsure ** (1 / POWER), { stated: at, error_px: px } = meter;
    const i = at.findIndex((one) => one >= stated), beyond = i < 0, warns = stated >= meter.limit;
    if (i <= 0) return { px: beyond ? px[px.length - 1] : px[0], beyond, warns };
    const share = (stated - at[i - 1]) / (at[i] - at[i - 1]);
    return { px: px[i - 1] + share * (px[i] - px[i - 1]), beyond, warns };
  }

  nothing() { return Object.fromEntries(this.manifest.state.map((one) => [one.name, numbers(one)])); }  // the state before any frame

  put(frame) {
    const port = this.manifest.state.find((one) => one.name === "frame");
    this.given.frame = numbers(port, TYPES[port.dtype].from(frame));
  }

  draws() {
    const made = {};
    for (const port of this.manifest.draws) {
      const values = new Float32Array(product(port.shape));
      const draw = port.law === "normal" ? normal : Math.random;
      for (let i = 0; i < values.length; i++) values[i] = draw();
      made[port.name] = numbers(port, values);
    }
    if (this.temperature !== null) made.temperature = numbers({ dtype: "float32", shape: [] }, Float32Array.of(this.temperature));
    return made;
  }

  async inputs(chunk) {  // of the next step
    const pair = new Float32Array(2 * this.width);
    pair.set(this.before); pair.set(chunk, this.width);
    const { actions: { type, data, dims } } = await this.stem.run({ chunks: new this.ort.Tensor("float32", pair, [2, this.width]) });
    return { actions: { type, data, dims }, ...this.draws(), ...this.given };
  }

  async better(other) {  // whether that model makes the same image as this one, in less time
    const inputs = { ...this.nothing(), ...await this.inputs(new Float32Array(this.width)) }, found = [];
    const make = async ({ step, decoder }) => (await decoder.run(await step.run(inputs, ["next_frame"]), ["image"])).image.data;
    for (const model of [this.model, other]) {
      await make(model);  // the first run also compiles
      const begun = performance.now(), pixels = await make(model);
      found.push({ ms: performance.now() - begun, pixels });
    }
    const [own, its] = found, off = own.pixels.reduce((sum, value, i) => sum + Math.abs(value - its.pixels[i]), 0);
    return its.ms < own.ms && off < own.pixels.length;  // a level each
  }

  async advance(chunk) {  // compute the next frame
    const names = this.manifest.state.map((one) => one.name);
    const { next_frame, uncertainty } = await this.model.step.run(await this.inputs(chunk), ["next_frame", "uncertainty"], names);
    this.given = {};
    this.frame = next_frame;
    this.before = Float32Array.from(chunk);
    const calibrated = uncertainty && this.temperature === this.manifest.temperature;
    this.unsure += calibrated ? uncertainty.data[0] ** POWER : NaN;
  }

  async image() {  // of the newest frame, as RGB bytes
    return (await this.model.decoder.run({ next_frame: this.frame }, ["image"])).image.data;
  }
}
