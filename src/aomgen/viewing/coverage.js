// Where the episodes of a run are, and where none is.
"use strict";
const BAR_WIDTH = 230, BAR_HEIGHT = 96;
buildHeader("Coverage");

async function load() {
  const asset = $("asset").value;
  try {
    const state = await ask("/coverage/state" + (asset && asset !== "*" ? `?asset=${asset}` : ""));
    if (!asset) $("asset").replaceChildren(new Option("all", "*"), ...state.assets.map((name, i) => new Option(name, i)));
    refresh(state);
  } catch (error) { say(error.message, true); }
}

function refresh(state) {
  $("note").hidden = state.draws.length > 0; $("content").hidden = !state.draws.length;
  if (!state.draws.length) return;
  $("map").innerHTML = drawMap(state);
  for (const mark of $("map").querySelectorAll(".pick")) mark.onclick = () => { location.href = "/review#episode=" + mark.dataset.number; };
  const count = outcome => state.draws.filter(d => d.outcome === outcome).length;
  $("legend").innerHTML = Object.entries(OUTCOMES).filter(([outcome]) => count(outcome)).map(([outcome, {name, color}]) =>
    `<span><i style="background:${color}"></i>${name} ${count(outcome)}</span>`).join("")
    + '<span><i style="background:#57b894"></i>the arm holds the handle</span><span><i style="background:#f3ead9"></i>free table</span><span><i style="background:#8a8f98"></i>obstacle</span><span>dashed: requested area; the line points where the front looks</span>';
  $("holes").innerHTML = state.holes.length ? state.holes.map((hole, i) => {
    const reasons = Object.entries(hole.reasons).map(([reason, n]) => `${n} ${reason.replaceAll("_", " ")}`).join(", ");
    return `<p><b>${i + 1}.</b> About x = ${hole.x.toFixed(2)} m, y = ${hole.y.toFixed(2)} m no episode is nearer than <b>${(100 * hole.radius_m).toFixed(hole.radius_m < 0.1 ? 1 : 0)} cm</b>. ${hole.draws ? `${hole.draws} ${hole.draws === 1 ? "sample" : "samples"} there gave none: ${escape(reasons)}.` : "There is no sample in this area."}</p>`;
  }).join("") : "<p>None: no position of the requested area is farther from an episode than twice the mean distance of evenly distributed ones.</p>";
  $("histograms").innerHTML = state.histograms.map(drawHistogram).join("");
  document.body.dataset.loaded = state.draws.length;
}

function drawHistogram(item) {
  const n = item.drawn.length, wide = BAR_WIDTH / n, tallest = Math.max(1, ...item.drawn), total = list => list.reduce((a, b) => a + b, 0);
  const bars = [["drawn", "#dde2e9"], ["tried", "#9fc3d0"], ["delivered", "#2c7a4b"]].map(([name, color]) => item[name].map((value, i) =>
    `<rect x="${(i * wide + 1).toFixed(1)}" y="${(16 + 58 * (1 - value / tallest)).toFixed(1)}" width="${(wide - 2).toFixed(1)}" height="${(58 * value / tallest).toFixed(1)}" fill="${color}"/>`).join("")).join("");
  const empty = item.delivered.map((value, i) => value ? "" : `<rect x="${(i * wide + 1).toFixed(1)}" y="74" width="${(wide - 2).toFixed(1)}" height="4" fill="#b3261e"/>`).join("");
  return `<svg viewBox="0 0 ${BAR_WIDTH} ${BAR_HEIGHT}">${bars}${empty}<text x="3" y="11">${escape(item.name)}${item.unit ? ` [${item.unit}]` : ""}: ${total(item.delivered)} of ${total(item.drawn)}</text>
    <text x="2" y="${BAR_HEIGHT - 5}">${+item.edges[0].toFixed(3)}</text><text x="${BAR_WIDTH - 2}" y="${BAR_HEIGHT - 5}" text-anchor="end">${+item.edges[n].toFixed(3)}</text></svg>`;
}
$("asset").onchange = load;
load();
