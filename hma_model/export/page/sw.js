// Keep what the page has loaded, so that it works offline; and let it use threads, which hosts without these headers forbid.

const CACHE = "hma-export";

self.addEventListener("install", () => self.skipWaiting());
self.addEventListener("activate", (event) => event.waitUntil(self.clients.claim()));

self.addEventListener("fetch", (event) => {
  const url = new URL(event.request.url), own = url.origin === location.origin;
  if (event.request.method !== "GET" || !(own || url.pathname.includes("onnxruntime-web"))) return;
  event.respondWith(answer(event.request, url, own));
});

async function answer(request, url, own) {
  const cache = await caches.open(CACHE);
  const kept = url.searchParams.has("v") ? await cache.match(url.href) : null;  // a version never changes
  if (kept) return isolated(kept, own);
  try {
    const found = await fetch(request);
    if (found.status === 200) await cache.put(url.href, found.clone()).catch(() => {});  // the storage may be full
    return isolated(found, own);
  } catch (fault) {
    const older = await cache.match(url.href);
    if (older) return isolated(older, own);
    throw fault;
  }
}

function isolated(response, own) {
  if (!own || response.type === "opaque" || response.redirected) return response;
  const headers = new Headers(response.headers);
  headers.set("Cross-Origin-Opener-Policy", "same-origin");
  headers.set("Cross-Origin-Embedder-Policy", "require-corp");
  headers.set("Cross-Origin-Resource-Policy", "same-origin");
  return new Response(response.body, { status: response.status, statusText: response.statusText, headers });
}
