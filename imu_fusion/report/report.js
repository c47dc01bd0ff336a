// Draw the figures from the JSON beside them and tie their time axes together.
const plots = [];
let following = false;

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

// Arrays come as base64 of float32: {"dtype": "f4", "bdata": ...}.
function decode(key, value) {
  if (value === null || value.dtype !== "f4") return value;
  return new Float32Array(Uint8Array.from(atob(value.bdata), (c) => c.charCodeAt(0)).buffer);
}

for (const element of document.querySelectorAll(".plot")) {
  const figure = JSON.parse(element.nextElementSibling.textContent, decode);
  Plotly.newPlot(element, figure.data, figure.layout, plotConfig).then((plot) => {
    if (!plot.classList.contains("linked")) return;
    plots.push(plot);
    plot.on("plotly_relayout", (event) => follow(plot, event));
  });
}
