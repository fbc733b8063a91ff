/* The site's search runs in a Worker, which browsers refuse to pages that are opened from a folder (file://).
   There an iframe takes its place: it runs the same script, and messages go to it and back.
   Material's own copy of such a script would come from another host; this one works without a network. */
if (location.protocol === "file:") {
  window.Worker = window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super()
      const script = String(new URL(url, location)).replace(/"/g, "%22")
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      this.frame.srcdoc = `<script>postMessage = parent.postMessage.bind(parent)<\/script><script src="${script}"><\/script>`
      this.ready = new Promise(done => { this.frame.onload = done })
      this.hear = event => {
        if (event.source !== this.frame.contentWindow) return
        const message = new MessageEvent("message", { data: event.data })
        this.dispatchEvent(message)
        if (this.onmessage) this.onmessage(message)
      }
      addEventListener("message", this.hear)
      document.body.append(this.frame)
    }
    postMessage(data) {
      // by this window's function: the frame's own one is the answer's way
      this.ready.then(() => window.postMessage.call(this.frame.contentWindow, data, "*"))
    }
    terminate() {
      removeEventListener("message", this.hear)
      this.frame.remove()
    }
  }
}
