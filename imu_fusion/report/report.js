// Unpack plotly and the figures, draw them, tie their time axes together, and make them printable.
const plots = [];
let following = false;
const narrow = window.innerWidth < 640;
const plotConfig = {
  responsive: true, displaylogo: false, displayModeBar: narrow ? false : "hover",
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
  toImageButtonOptions: {format: "svg"},
};

// Plotly reads back what it has drawn; browsers warn where they have not been told before.
const contextOf = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  return contextOf.call(this, kind, kind === "2d" ? {willReadFrequently: true, ...options} : options);
};

async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// An array of float32 comes as all first bytes, all second ones, ...
async function floats(text) {
  const bytes = await unpack(text);
  const count = bytes.length / 4;
  const ordered = new Uint8Array(bytes.length);
  for (let i = 0; i < count; i++) {
    for (let j = 0; j < 4; j++) ordered[4 * i + j] = bytes[j * count + i];
  }
  return new Float32Array(ordered.buffer);
}

async function figureOf(text) {
  const arrays = await Promise.all(JSON.parse(text).arrays.map(floats));
  return JSON.parse(text, (key, value) => (
    value !== null && value.array !== undefined ? arrays[value.array] : value));
}

// On a phone, margins and labels leave most of the width to the signals.
function squeeze(figure) {
  const layout = figure.layout;
  layout.margin.l = Math.min(layout.margin.l, 58);
  layout.margin.r = Math.min(layout.margin.r, 10);
  for (const label of layout.annotations || []) {
    if (label.xshift < -40) label.xshift = -42;
  }
  for (const eye of layout.scene ? [layout.scene.camera.eye] : []) {
    for (const axis of "xyz") eye[axis] *= 1.5;
  }
  for (const trace of figure.data) {
    for (const part of [trace.marker, trace.line]) {
      if (part && part.colorbar) {
        Object.assign(part.colorbar, {orientation: "h", x: 0.5, y: -0.12, yanchor: "top", len: 0.9});
        part.colorbar.title.side = "top";
      }
    }
  }
}

function timeRange(event) {
  if (event["xaxis.range[0]"] !== undefined) {
    return {"xaxis.range[0]": event["xaxis.range[0]"], "xaxis.range[1]": event["xaxis.range[1]"]};
  }
  if (event["xaxis.range"]) {
    return {"xaxis.range": event["xaxis.range"].slice()};
  }
  return event["xaxis.autorange"] ? {"xaxis.autorange": true} : null;
}

function follow(source, event) {
  const update = following ? null : timeRange(event);
  if (!update) return;
  following = true;
  const others = plots.filter((plot) => plot !== source);
  Promise.all(others.map((plot) => Plotly.relayout(plot, update)))
    .finally(() => { following = false; });
}

// WebGL cannot be printed: beside each view in space there is a picture of it for that.
async function picture(plot) {
  const image = plot.nextElementSibling;
  image.src = await Plotly.toImage(plot, {format: "png", scale: 2});
}

async function draw(element) {
  const figure = await figureOf(element.parentElement.querySelector("script").textContent);
  if (narrow) squeeze(figure);
  const plot = await Plotly.newPlot(element, figure.data, figure.layout, plotConfig);
  if (figure.layout.scene) {
    plot.classList.add("spatial");
    plot.insertAdjacentElement("afterend", Object.assign(new Image(), {className: "printed"}));
    await picture(plot);
    plot.on("plotly_relayout", () => picture(plot));
  } else if (plot.classList.contains("linked")) {
    plots.push(plot);
    plot.on("plotly_relayout", (event) => follow(plot, event));
  }
}

// Drawings in the plane are scaled to the paper.
addEventListener("beforeprint", () => {
  for (const plot of document.querySelectorAll(".plot:not(.spatial)")) {
    const {width, height} = plot._fullLayout;
    plot.style.setProperty("--ratio", `${width} / ${height}`);
    for (const svg of plot.querySelectorAll(".main-svg")) {
      svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    }
  }
});
addEventListener("afterprint", () => {
  for (const svg of document.querySelectorAll(".main-svg")) svg.removeAttribute("viewBox");
});

(async () => {
  const code = new TextDecoder().decode(
    await unpack(document.getElementById("plotly").textContent));
  document.head.append(Object.assign(document.createElement("script"), {text: code}));
  for (const element of document.querySelectorAll(".plot")) await draw(element);
})();
