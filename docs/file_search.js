// Browsers start no worker from a file. Where the site is opened from a folder, the worker of its
// search runs in a hidden frame instead; on a server nothing changes.
class FrameWorker extends EventTarget {
  constructor(url) {
    super();
    const frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.appendChild(frame);
    this.frame = frame.contentWindow;
    const page = this.frame.document;
    page.open();
    this.frame.postMessage = (data) =>
      this.dispatchEvent(new MessageEvent("message", { data }));
    this.ready = new Promise((resolve, reject) => {
      const script = page.createElement("script");
      script.onload = resolve;
      script.onerror = reject;
      script.src = url;
      page.write("<body></body>");
      page.body.appendChild(script);
    });
    page.close();
  }

  postMessage(data) {
    this.ready.then(() => this.frame.dispatchEvent(new MessageEvent("message", { data })));
  }
}

if (location.protocol === "file:") {
  window.Worker = FrameWorker;
}
