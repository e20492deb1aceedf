// The wall: all draws, filtered and sorted; keys decide about the focused card.
"use strict";
// Interval of looking for new draws and decisions of other windows, [ms].
const POLL_MS = 3000;
const NAMES = {committed: "episodes", rejected: "rejected", skipped: "skipped", damaged: "damaged"};
const ORDER = ["damaged", "committed", "rejected", "skipped"];
const DECISIONS = {undecided: "undecided", accepted: "accepted", rejected: "rejected"};
let draws = [], meanings = {}, version = "", cards = new Map(), hidden = new Set(), shown = [], scrolled = 0;
const review = {run: ""};

buildHeader("Review");
const fill = (id, options, any) => {
  const box = $(id), kept = box.value;
  box.replaceChildren(new Option(any, "*"), ...options.map(([value, name]) => new Option(name, value)));
  box.value = [...box.options].some(o => o.value === kept) ? kept : "*";
};

async function load() {
  try {
    const state = await ask("/review/draws?version=" + version);
    if (state.version !== version) {
      ({draws, meanings, version} = state);
      review.run = state.run;
      refresh();
    }
    if ($("status").className === "poor" && $("status").dataset.source === "wall") say("");
  } catch (error) { say(error.message, true); $("status").dataset.source = "wall"; }
}

function refresh() {
  const count = outcome => draws.filter(d => d.outcome === outcome).length;
  $("outcomes").replaceChildren(...Object.keys(NAMES).filter(outcome => count(outcome)).map(outcome => {
    const button = make("button", {type: "button", textContent: `${NAMES[outcome]} ${count(outcome)}`, data: {outcome}});
    button.setAttribute("aria-pressed", !hidden.has(outcome));
    button.onclick = () => { hidden.has(outcome) ? hidden.delete(outcome) : hidden.add(outcome); refresh(); };
    return button;
  }));
  const distinct = values => [...new Set(values)].sort();
  fill("asset", distinct(draws.map(d => d.asset)).map(v => [v, v]), "all");
  fill("reason", distinct(draws.map(d => d.reason)).map(v => [v, `${v.replaceAll("_", " ")} (${draws.filter(d => d.reason === v).length})`]), "all");
  fill("decision", Object.entries(DECISIONS), "all");
  fill("tag", distinct(draws.flatMap(d => d.tags)).map(v => [v, v]), "all");
  $("known").replaceChildren(...distinct(draws.flatMap(d => d.tags)).map(v => new Option(v)));
  const chosen = id => $(id).value, fits = (id, value) => chosen(id) === "*" || chosen(id) === value;
  shown = draws.filter(d => !hidden.has(d.outcome) && fits("asset", d.asset) && fits("reason", d.reason)
    && (chosen("decision") === "*" || (d.outcome === "committed" && (d.decision || "undecided") === chosen("decision")))
    && (chosen("tag") === "*" || d.tags.includes(chosen("tag"))));
  const near = d => d.room === null ? Infinity : Math.abs(d.room);
  // Episodes come first: they are what a person decides about.
  const rank = d => ORDER.indexOf(d.outcome);
  shown.sort(chosen("sort") === "room" ? (a, b) => rank(a) - rank(b) || near(a) - near(b) || a.number - b.number : (a, b) => a.number - b.number);
  const decided = value => draws.filter(d => d.outcome === "committed" && d.decision === value).length;
  $("count").innerHTML = `${shown.length} of ${draws.length} samples; ${decided("accepted")} accepted, ${decided("rejected")} rejected, ${decided("")} undecided.`
    + (decided("rejected") ? ` <code>aomgen export</code> and the next <code>aomgen run</code> leave out ${decided("rejected")}.` : "");
  $("note").hidden = draws.length > 0;
  $("note").textContent = "There is no episode yet, because the stage “episodes” has not started.";
  $("cards").replaceChildren(...shown.map(card));
  document.body.dataset.loaded = draws.length;
}

// The card of a draw; one that has not changed is used again.
function card(draw) {
  const text = JSON.stringify(draw), known = cards.get(draw.number);
  if (known && known.text === text) return known.card;
  const link = make("a", {className: `card ${draw.outcome}`, href: `#episode=${draw.number}`, data: {number: draw.number, decision: draw.decision}});
  const thumbnail = frame => `<img loading="lazy" decoding="async" alt="${frame} frame" src="/review/thumbnail?number=${draw.number}&frame=${frame}">`;
  const images = draw.outcome === "committed" ? `<div class="pair">${thumbnail("first")}${thumbnail("last")}</div>` : "";
  const badge = draw.decision ? `<span class="badge ${draw.decision}">${draw.decision === "accepted" ? "✓" : "✗"} ${draw.decision}</span>` : "";
  const cause = draw.outcome === "committed" ? `${escape(draw.reason)} <span class="dim">${escape(draw.detail.replaceAll(" %", "\u00a0%"))}</span>` : `<b>${escape(draw.reason.replaceAll("_", " "))}</b>`;
  const sentence = draw.outcome === "committed" ? "" : `<div class="dim">${escape(draw.detail || meanings[draw.reason] || "")}</div>`;
  const share = draw.room === null ? null : Math.min(Math.abs(draw.room), 1);
  const kind = draw.room === null || draw.room < 0 ? "over" : draw.room < 0.25 ? "tight" : "";
  link.innerHTML = `${images}<div class="line"><b>${String(draw.number).padStart(6, "0")}</b><span>${escape(draw.asset)}</span>${badge}</div>
    <div class="dim">${escape(draw.place)}</div><div>${cause}</div>${sentence}
    ${share === null ? "" : `<div class="room" title="${draw.room < 0 ? "beyond the limit by" : "normalized margin to the limit:"} ${(100 * Math.abs(draw.room)).toFixed(0)} %"><i class="${kind}" style="width:${(100 * share).toFixed(0)}%"></i></div>`}
    ${draw.tags.map(tag => `<span class="chip">${escape(tag)}</span>`).join("")}${draw.note ? `<div class="dim">${escape(draw.note)}</div>` : ""}`;
  cards.set(draw.number, {text, card: link});
  return link;
}

// Send a change, and show what is on disk then.
async function decide(number, change) {
  try {
    const stored = await ask("/review/change", {number, change});
    const draw = draws.find(d => d.number === number);
    Object.assign(draw, stored);
    version = "";
    refresh();
    say(`stored the review of episode ${number}`);
    return draw;
  } catch (error) { say(error.message, true); return null; }
}
const toggle = (draw, decision) => decide(draw.number, {decision: draw.decision === decision ? "" : decision});

function route() {
  const link = readLink(), number = Number(link.episode);
  const open = link.episode !== undefined;
  if (open && $("episode").hidden) scrolled = $("wall").scrollTop;
  $("wall").hidden = open; $("episode").hidden = !open;
  if (open) openEpisode(number, Number(link.t || 0));
  else { closeEpisode(); $("wall").scrollTop = scrolled; }
}

for (const id of ["asset", "reason", "decision", "tag", "sort"]) $(id).onchange = refresh;
$("filters").onsubmit = event => event.preventDefault();
window.onhashchange = route;
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || /INPUT|TEXTAREA|SELECT/.test(event.target.tagName) && event.target.type !== "range") return;
  if (!$("episode").hidden) { pressKey(event); return; }
  const focused = document.activeElement.closest ? document.activeElement.closest(".card.committed") : null;
  const decision = {a: "accepted", r: "rejected"}[event.key.toLowerCase()];
  if (!focused || !decision) return;
  const number = Number(focused.dataset.number);
  toggle(draws.find(d => d.number === number), decision).then(() => { const again = cards.get(number); if (again) again.card.focus(); });
});
load().then(route);
setInterval(() => { if (document.visibilityState === "visible") load(); }, POLL_MS);
