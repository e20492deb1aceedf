// The page of one draw: all views in step, plots, limits, and the decision.
"use strict";
let episode = null, frame = 0, playing = null, moveCursor = () => {}, links = [], opened = 0, seeking = false;

async function openEpisode(number, seconds) {
  if (episode && episode.number === number) { if (episode.frames) show(Math.round(seconds * episode.fps)); return; }
  closeEpisode();
  const ticket = ++opened;
  $("name").textContent = `Draw ${number}`;
  let found;
  try { found = await ask("/review/draw?number=" + number); }
  catch (error) { if (ticket === opened) { say(error.message, true); $("verdict").innerHTML = `<p class="poor">${escape(error.message)}</p>`; } return; }
  if (ticket !== opened) return;
  episode = found;
  const committed = episode.outcome === "committed";
  $("player").hidden = $("decide").hidden = !committed;
  $("name").textContent = `${committed ? "Episode" : "Sample"} ${String(number).padStart(6, "0")}`;
  $("facts").textContent = [episode.asset, episode.place, committed ? `${(episode.frames / episode.fps).toFixed(1)} s` : NAMES[episode.outcome]].filter(Boolean).join(", ");
  $("twin").hidden = episode.outcome === "damaged";
  $("twin").textContent = committed ? "Show in the twin" : "Plan again and show in the twin";
  $("twin").href = "/#" + new URLSearchParams({episode: number, t: seconds});
  describeVerdict();
  describeReview();
  // A draw without images shows the map in their place.
  (committed ? $("limits") : $("plots")).before($("where"));
  drawWhere(ticket);
  if (!committed) { document.body.dataset.opened = number; return; }
  moveCursor = drawPlots($("plots"), episode, picked => { pause(); show(picked); });
  $("scrub").max = episode.frames - 1;
  await loadVideos(ticket);
  if (ticket !== opened) return;
  show(Math.round(seconds * episode.fps));
  document.body.dataset.opened = number;
}

function closeEpisode() {
  pause();
  opened++; episode = null; frame = 0; moveCursor = () => {};
  for (const id of ["views", "plots", "verdict", "limits", "where", "tags"]) $(id).replaceChildren();
  links.forEach(URL.revokeObjectURL); links = [];
  delete document.body.dataset.opened;
}

async function loadVideos(ticket) {
  const views = episode.cameras.map((camera, i) => {
    const video = make("video", {muted: true, playsInline: true, preload: "auto"});
    video.style.aspectRatio = `${camera.width}/${camera.height}`;
    $("views").append(make("figure", {}, video, make("figcaption", {textContent: camera.name})));
    return (async () => {
      const answer = await fetchOrSay(`/review/video?number=${episode.number}&camera=${i}`), blob = await answer.blob();
      if (ticket !== opened) return;
      links.push(video.src = URL.createObjectURL(blob));
      await new Promise((resolve, reject) => { video.onloadeddata = resolve; video.onerror = () => reject(new Error(`the browser cannot play camera ${camera.name}`)); });
    })();
  });
  for (const view of await Promise.allSettled(views)) if (view.status === "rejected") say(view.reason.message, true);
}

// Show a frame in all views and plots. While the views still seek, only the latest request is kept.
function show(wanted) {
  if (!episode || !episode.frames) return;
  frame = Math.min(Math.max(wanted, 0), episode.frames - 1);
  $("scrub").value = frame;
  const phase = episode.phases.find(p => frame <= p.last);
  $("time").textContent = `${(frame / episode.fps).toFixed(2)} s, frame ${frame}, ${phase.name}`;
  moveCursor(frame);
  const link = {episode: episode.number, t: (frame / episode.fps).toFixed(2)};
  $("twin").href = "/#" + new URLSearchParams(link);
  if (!playing) writeLink(link);
  seek();
}
async function seek() {
  if (seeking) return;
  seeking = true;
  const ticket = opened;
  for (let shownFrame = -1; shownFrame !== frame && ticket === opened;) {
    shownFrame = frame;
    const time = (shownFrame + 0.5) / episode.fps;
    await Promise.all([...$("views").querySelectorAll("video")].filter(v => v.readyState > 0).map(video => new Promise(resolve => {
      if (Math.abs(video.currentTime - time) < 1e-3) { resolve(); return; }
      video.onseeked = resolve;
      video.currentTime = time;
    })));
    document.body.dataset.frame = shownFrame;
  }
  seeking = false;
  if (ticket !== opened && episode) seek();
}

function play() {
  if (!episode || !episode.frames) return;
  const from = frame >= episode.frames - 1 ? 0 : frame, start = performance.now();
  const step = now => {
    const at = from + Math.floor((now - start) / 1000 * episode.fps);
    if (at !== frame) show(at);
    if (at >= episode.frames - 1) { pause(); return; }
    playing = requestAnimationFrame(step);
  };
  playing = requestAnimationFrame(step);
  $("play").textContent = "Pause";
}
function pause() {
  if (playing) cancelAnimationFrame(playing);
  playing = null;
  $("play").textContent = "Play";
  if (episode && episode.frames) show(frame);
}

function describeVerdict() {
  const committed = episode.outcome === "committed";
  const cause = committed ? `Nearest limit: ${episode.reason}` : episode.reason.replaceAll("_", " ");
  const parts = [`<p class="cause ${committed ? "" : "poor"}">${escape(cause)}</p>`, `<p>${escape(episode.detail)}</p>`];
  if (!committed && episode.meaning) parts.push(`<p class="dim">${escape(episode.meaning)}.</p>`);
  if (episode.pair) parts.push(`<p>Colliding pair: <b>${escape(episode.pair)}</b></p>`);
  $("verdict").innerHTML = parts.join("");
  const rows = committed
    ? episode.limits.map(item => `<tr title="${escape(item.setting && "worst in setting: " + item.setting)}"><td>${escape(item.name)}</td><td class="n">${escape(item.value)}</td><td class="n dim">${escape(item.limit)}</td><td><div class="room"><i class="${item.room < 0.25 ? "tight" : ""}" style="width:${Math.min(100 * item.room, 100).toFixed(0)}%"></i></div></td></tr>`)
    : Object.entries(episode.figures).map(([name, value]) => `<tr><td>${escape(name)}</td><td class="n">${escape(value)}</td></tr>`);
  const differs = Object.entries(episode.variation).map(([name, value]) => `<tr><td>${escape(name)}</td><td class="n">${escape(value)}</td></tr>`);
  const facts = committed ? [["instruction", episode.instruction], ["grasp", episode.grasp], ["simulated in", episode.settings.join("; ")]] : [];
  $("limits").innerHTML = (rows.length ? `<h3>${committed ? "Limits, the nearest first" : "Figures"}</h3><table class="${committed ? "four" : ""}">${rows.join("")}</table>` : "")
    + `<h3 style="margin-top:12px">Differs from the recording</h3><table><tr><td>position and yaw</td><td class="n">${escape(episode.place)}</td></tr>${differs.join("")}</table>`
    + (facts.length ? `<h3 style="margin-top:12px">Made as</h3><table>${facts.map(([name, value]) => `<tr><td>${name}</td><td>${escape(value)}</td></tr>`).join("")}</table>` : "");
}

function describeReview() {
  $("accept").setAttribute("aria-pressed", episode.decision === "accepted");
  $("reject").setAttribute("aria-pressed", episode.decision === "rejected");
  $("tags").replaceChildren(...episode.tags.map(tag => {
    const remove = make("button", {textContent: "×", title: `remove the tag ${tag}`, onclick: () => update({remove_tags: [tag]})});
    return make("span", {className: "chip", textContent: tag}, remove);
  }));
  if (document.activeElement !== $("text")) $("text").value = episode.note;
}

async function drawWhere(ticket) {
  try {
    const state = await ask("/coverage/state");
    if (ticket !== opened || !state.draws.length) return;
    $("where").innerHTML = `<h3>Position, top view</h3>` + drawMap(state, new Set([episode.number]));
  } catch (error) { if (ticket === opened) $("where").textContent = error.message; }
}

async function update(change) {
  const number = episode.number, draw = await decide(number, change);
  if (!draw || !episode || episode.number !== number) return;
  Object.assign(episode, {decision: draw.decision, tags: draw.tags, note: draw.note});
  describeReview();
}
const choose = decision => update({decision: episode.decision === decision ? "" : decision});

// Open the draw before or after this one in the order of the wall.
function walk(step) {
  const place = shown.findIndex(d => d.number === (episode || {}).number), next = shown[place + step];
  if (place >= 0 && next) location.hash = "episode=" + next.number;
  else say(step > 0 ? "this is the last sample" : "this is the first sample");
}

function pressKey(event) {
  const key = event.key.toLowerCase(), committed = episode && episode.outcome === "committed";
  const actions = {escape: () => { location.hash = ""; }, j: () => walk(1), k: () => walk(-1)};
  if (committed) Object.assign(actions, {
    a: () => choose("accepted"), r: () => choose("rejected"), t: () => $("newtag").focus(), n: () => $("text").focus(),
    " ": () => playing ? pause() : play(), arrowleft: () => { pause(); show(frame - 1); }, arrowright: () => { pause(); show(frame + 1); },
  });
  if (!actions[key]) return;
  event.preventDefault();
  actions[key]();
}

$("back").onclick = () => { location.hash = ""; };
$("next").onclick = () => walk(1);
$("previous").onclick = () => walk(-1);
$("play").onclick = () => playing ? pause() : play();
$("accept").onclick = () => choose("accepted");
$("reject").onclick = () => choose("rejected");
$("scrub").oninput = () => { const wanted = Number($("scrub").value); pause(); show(wanted); };
$("newtag").onkeydown = event => {
  const tag = $("newtag").value.trim();
  if (event.key === "Enter" && tag) { update({add_tags: [tag]}); $("newtag").value = ""; }
  if (event.key === "Enter" || event.key === "Escape") $("newtag").blur();
};
$("text").onkeydown = event => { if (event.key === "Escape" || event.key === "Enter" && event.ctrlKey) $("text").blur(); };
$("text").onblur = () => { if (episode && $("text").value.trim() !== episode.note) update({note: $("text").value}); };
