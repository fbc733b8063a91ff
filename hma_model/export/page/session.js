// Run a graph in a worker, and keep there what its next run takes of this one.

import { startRuntime } from "./world.js";

let ort, session, held = {};

onmessage = async ({ data: { runtime, graph, threads, providers, inputs, keep, give } }) => {
  try {
    if (inputs) return postMessage(await run(inputs, keep, give));
    ort = await startRuntime(runtime, threads);
    session = await ort.InferenceSession.create(graph, { executionProviders: providers });
    postMessage({});
  } catch (fault) { postMessage({ fault: fault.message || String(fault) }); }
};

async function run(inputs, keep, give) {
  const given = Object.entries(inputs).map(([name, { type, data, dims }]) => [name, new ort.Tensor(type, data, dims)]);
  const made = await session.run({ ...held, ...Object.fromEntries(given) });
  if (keep.length) held = Object.fromEntries(keep.map((name) => [name, made["next_" + name]]));
  const found = give.filter((name) => made[name]);
  return { made: Object.fromEntries(found.map((name) => [name, { type: made[name].type, data: made[name].data, dims: made[name].dims }])) };
}
