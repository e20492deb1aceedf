// Draws of a run from above: x to the right, y up.
"use strict";
const OUTCOMES = {
  committed: {name: "episode", color: "#2c7a4b"}, rejected: {name: "rejected", color: "#d1495b"},
  skipped: {name: "skipped", color: "#b9c2cf"}, damaged: {name: "damaged", color: "#e8a33d"},
};
const MAP_PX = 640, MAP_ROOM_M = 0.12, LINED = 400;

// SVG text of a map of the requested area; draws in `lit` (a set of numbers, or null for all) are drawn strongly.
function drawMap(state, lit = null) {
  const corners = [...state.requested.flat(), ...state.draws.map(d => [d.x, d.y]), ...(lit ? [] : state.holes).flatMap(h => [[h.x - h.radius_m, h.y - h.radius_m], [h.x + h.radius_m, h.y + h.radius_m]])];
  const low = [0, 1].map(k => Math.min(...corners.map(c => c[k])) - MAP_ROOM_M), high = [0, 1].map(k => Math.max(...corners.map(c => c[k])) + MAP_ROOM_M);
  const scale = MAP_PX / (high[0] - low[0]), height = scale * (high[1] - low[1]);
  const at = ([x, y]) => `${(scale * (x - low[0])).toFixed(1)},${(height - scale * (y - low[1])).toFixed(1)}`;
  const polygon = (points, style) => `<polygon points="${points.map(at).join(" ")}" ${style}/>`;
  // Marks of many draws are small, so that they do not hide each other; from LINED draws on they have no direction.
  const size = Math.min(4, Math.max(1.5, 4 * Math.sqrt(100 / state.draws.length)));
  const order = ["skipped", "damaged", "rejected", "committed"];
  const draws = [...state.draws].sort((a, b) => order.indexOf(a.outcome) - order.indexOf(b.outcome)).map(draw => {
    const strong = !lit || lit.has(draw.number), color = OUTCOMES[draw.outcome].color, [cx, cy] = at([draw.x, draw.y]).split(",");
    return `<g class="pick" data-number="${draw.number}" opacity="${strong ? 1 : 0.25}"><title>${draw.number} ${escape(draw.asset)}: ${escape(OUTCOMES[draw.outcome].name)}${draw.reason ? ", " + escape(draw.reason.replaceAll("_", " ")) : ""}</title>
      ${state.draws.length > LINED && !(lit && strong) ? "" : `<polyline points="${at([draw.x, draw.y])} ${at([draw.x + draw.dx, draw.y + draw.dy])}" stroke="${color}" stroke-width="${lit && strong ? 4 : size / 2}"/>`}<circle cx="${cx}" cy="${cy}" r="${lit && strong ? 9 : size}" fill="${color}"${lit && strong ? ' stroke="#1c2430" stroke-width="2"' : ""}/></g>`;
  });
  const holes = state.holes.map((hole, i) => {
    const [cx, cy] = at([hole.x, hole.y]).split(",");
    return `<circle cx="${cx}" cy="${cy}" r="${(scale * hole.radius_m).toFixed(1)}" fill="#d1495b22" stroke="#b3261e" stroke-dasharray="5 4"/><text x="${cx}" y="${cy}" text-anchor="middle" style="fill:#b3261e;font-weight:600">gap ${i + 1}</text>`;
  });
  return `<svg class="map" viewBox="0 0 ${MAP_PX} ${height.toFixed(0)}">
    ${state.shapes.map(s => polygon(s.points, `fill="${s.color}" fill-opacity="${s.opacity.toFixed(2)}"`)).join("")}
    ${state.requested.map(points => polygon(points, 'fill="none" stroke="#1f6f8b" stroke-width="1.5" stroke-dasharray="6 4"')).join("")}
    ${lit ? "" : holes.join("")}${draws.join("")}
    <path d="M${at([0, 0])}m-7,0h14m-7,-7v14" stroke="#1c2430" stroke-width="2"/>
    <text x="4" y="${(height - 5).toFixed(0)}">x ${low[0].toFixed(2)} m, y ${low[1].toFixed(2)} m</text><text x="${MAP_PX - 4}" y="13" text-anchor="end">x ${high[0].toFixed(2)} m, y ${high[1].toFixed(2)} m</text></svg>`;
}
