// Make the images of frames beside the page, in a worker.

import { startRuntime } from "./world.js";

let ort, session;

onmessage = async ({ data: { runtime, graph, threads, type, data, dims } }) => {
  try {
    if (!graph) return postMessage(await decode(new ort.Tensor(type, data, dims)));
    ort = await startRuntime(runtime, threads);
    session = await ort.InferenceSession.create(graph, { executionProviders: ["wasm"] });
    postMessage({});
  } catch (fault) { postMessage({ fault: fault.message || String(fault) }); }
};

async function decode(frame) {
  const { image } = await session.run({ next_frame: frame });
  return { image: image.data };
}
