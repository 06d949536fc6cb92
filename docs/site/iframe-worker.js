// Browsers refuse a worker on a page of file://. There, the search runs in a hidden frame instead,
// which takes and sends messages as a worker does.
"use strict";
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      frame.title = "search";
      document.documentElement.append(frame);
      const inside = frame.contentWindow;
      this.ready = new Promise((done) => {
        inside.document.open();
        inside.document.write("<!doctype html><title>search</title><body></body>");
        inside.document.close();
        inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
        inside.importScripts = (...urls) =>
          urls.reduce((before, next) => before.then(() => load(inside, next)), Promise.resolve());
        load(inside, url).then(done);
      });
      this.inside = inside;
    }
    postMessage(data) {
      this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })));
    }
  };
}

// Runs a script in the frame.
function load(inside, url) {
  return new Promise((done, failed) => {
    const script = inside.document.createElement("script");
    script.src = new URL(url, location).href;
    script.onload = done;
    script.onerror = failed;
    inside.document.body.append(script);
  });
}
