// Plots of series over the frames of an episode, with phases behind and a cursor at the current frame.
"use strict";
const LINE_COLORS = ["#1f6f8b", "#d1495b", "#e8a33d", "#2c7a4b", "#7b5ea7", "#66707f"];
const PHASE_COLORS = {approach: "#fafbfc", contact: "#f5d76e55", retreat: "#eef1f5"};
const PLOT_HEIGHT = 84, PLOT_BOTTOM = 14;

// A new element with properties and children; `data` sets data attributes.
function make(tag, properties = {}, ...children) {
  const {data, ...rest} = properties, element = document.createElement(tag);
  Object.assign(element, rest);
  Object.assign(element.dataset, data);
  element.append(...children.filter(child => child !== null && child !== undefined));
  return element;
}
const escape = text => String(text).replace(/[&<>"]/g, c => ({"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;"}[c]));
const shorten = value => Math.abs(value) < 0.005 ? "0" : Math.abs(value) >= 100 ? value.toFixed(0) : value.toFixed(Math.abs(value) >= 10 ? 1 : 2);

// Draw the plots of an episode into `home`; returns a function that moves the cursor to a frame.
function drawPlots(home, episode, onPick) {
  const movers = episode.series.map((series, i) => drawPlot(home, series, episode, i === 0, onPick));
  return frame => movers.forEach(move => move(frame));
}

function drawPlot(home, series, episode, named, onPick) {
  const last = Math.max(episode.frames - 1, 1), box = make("div", {className: "plot"}), title = make("h3");
  home.append(box);
  const values = series.lines.flatMap(line => line.values).concat(series.levels.map(level => level.value));
  let low = Math.min(...values), high = Math.max(...values);
  if (high - low < 1e-9) { low -= 0.5; high += 0.5; }
  const width = Math.max(box.clientWidth - 18, 100), bottom = PLOT_HEIGHT - PLOT_BOTTOM;
  const x = frame => frame / last * width, y = value => 4 + (bottom - 8) * (high - value) / (high - low);
  const phases = episode.phases.map(phase => {
    const left = x(Math.max(phase.first - 0.5, 0)), right = x(Math.min(phase.last + 0.5, last));
    const name = named ? `<text x="${left + 34}" y="${bottom + 12}">${phase.name}</text>` : "";
    return `<rect x="${left}" y="0" width="${right - left}" height="${bottom}" fill="${PHASE_COLORS[phase.name]}"/>${name}`;
  });
  const levels = series.levels.map(level =>
    `<line x1="0" x2="${width}" y1="${y(level.value)}" y2="${y(level.value)}" stroke="#d1495b" stroke-dasharray="4 4" opacity=".6"/>`);
  const lines = series.lines.map((line, i) =>
    `<polyline fill="none" stroke="${LINE_COLORS[i % LINE_COLORS.length]}" stroke-width="1.6" points="${line.values.map((v, f) => `${x(f).toFixed(1)},${y(v).toFixed(1)}`).join(" ")}"/>`);
  const end = named ? "" : `<text x="${width}" y="${bottom + 12}" text-anchor="end">${(last / episode.fps).toFixed(1)} s</text>`;
  box.innerHTML = `<svg viewBox="0 0 ${width} ${PLOT_HEIGHT}" preserveAspectRatio="none">${phases.join("")}${levels.join("")}${lines.join("")}${end}
    <text x="2" y="10">${shorten(high)}</text><text x="2" y="${bottom + 11}">${shorten(low)}</text>
    <line class="cursor" y1="0" y2="${bottom}" stroke="#1c2430" stroke-width="1"/></svg>`;
  box.prepend(title);
  const svg = box.querySelector("svg"), cursor = box.querySelector(".cursor");
  const pick = event => onPick(Math.round(Math.min(Math.max((event.clientX - svg.getBoundingClientRect().left) / svg.getBoundingClientRect().width, 0), 1) * last));
  svg.onpointerdown = event => { svg.setPointerCapture(event.pointerId); pick(event); };
  svg.onpointermove = event => { if (event.buttons) pick(event); };
  return frame => {
    cursor.setAttribute("x1", x(frame)); cursor.setAttribute("x2", x(frame));
    const shown = series.lines.map((line, i) => `<span><b style="color:${LINE_COLORS[i % LINE_COLORS.length]}">&#9632;</b> ${escape(line.name)} ${shorten(line.values[Math.min(frame, line.values.length - 1)])}</span>`);
    const goals = series.levels.map(level => `<span>${escape(level.name)} ${shorten(level.value)}</span>`);
    title.innerHTML = `${escape(series.title)} [${escape(series.unit)}] ${shown.join("")}${goals.join("")}`;
  };
}
