// The twin page: a view that a person moves, a pose, a timeline, overlays, and the recorded video beside or over it.
"use strict";
const COLORS = {collider: "#35c4ff", pair: "#ff3b30", scan: "#ffd166", fixed: "#ff6b6b", region: "#8fa8ff80", axis: "#4d7bff", contact: "#ff3df2"};
const COVERAGE = ["#f0524b", "#f2c230", "#45b86b"];
const PARTS = {background: "background", robot: "robot", static: "object's body", moving: "moving part"};
const OVERLAYS = {colliders: "colliders", cameras: "cameras", coverage: "coverage", contacts: "contacts", axis: "joint axis"};
const SWATCHES = {colliders: COLORS.collider, cameras: COLORS.scan, coverage: COVERAGE[2], contacts: COLORS.contact, axis: COLORS.axis};
// A view is drawn sharply when it has not changed for this long, [ms], at most so wide, [px].
const QUIET_MS = 200, WIDEST = 1280;
// A drawing while the view moves takes at most about this long, or it is drawn smaller, [ms].
const MOVING_MS = 120, NARROWEST = 240;
// The run is looked up again after this long, [ms].
const POLL_MS = 4000;

let run, motion, home, atHome = true, T, pivot, frame = 0, pose = null, byHand = false;
let playing = null, compare = "off", filmed, wipe = 0.5, last = null, changed = 0, movingWidth = 0, drawings = 0;
const parts = new Set(Object.keys(PARTS)), overlays = new Set();
const view = $("view"), over = $("over"), film = $("film");

// Calls of the result run `work` one after the other, and only for the latest of those that came meanwhile.
function latest(work) {
  let wanted = false, busy = false;
  return async () => {
    wanted = true;
    if (busy) return;
    busy = true;
    while (wanted) {
      wanted = false;
      try { await work(); } catch (error) { say(error.message, true); playing = null; refreshTime(); }
    }
    busy = false;
  };
}

const optics = () => motion.cameras[home];
const poseAt = (camera, index) => camera.Ts_world_cam[Math.min(index, camera.Ts_world_cam.length - 1)];
const seconds = () => motion.times[frame];
const nearestFrame = time => motion.times.reduce((best, value, k) => Math.abs(value - time) < Math.abs(motion.times[best] - time) ? k : best, 0);

// ---- Drawing.

let quiet = 0;
function touch() {
  changed = performance.now();
  redraw();
  clearTimeout(quiet);
  quiet = setTimeout(redraw, QUIET_MS + 20);
}

const redraw = latest(async () => {
  if (!motion || !motion.scene) { drawPlain(); return; }
  const still = performance.now() - changed >= QUIET_MS, size = layout(optics().width / optics().height);
  const sharp = Math.min(WIDEST, Math.round(size * devicePixelRatio));
  // A difference is that of images of one size; else it would show how sharp they are.
  const equal = compare === "difference" && comparable();
  const width = equal ? optics().width : still ? sharp : Math.min(sharp, movingWidth || optics().width);
  const request = {motion: motion.name, camera: home, T_world_cam: T, width, time: seconds(), ...pose, parts: [...parts], overlays: [...overlays]};
  const text = JSON.stringify(request);
  document.body.dataset.sharp = still && Boolean(last && last.text === text);
  if (last && last.text === text) { paint(); return; }
  const start = performance.now();
  const answer = await ask("/api/draw", request);
  const image = new Image();
  image.src = "data:image/jpeg;base64," + answer.image;
  await image.decode();
  if (!still && !equal) {
    const took = performance.now() - start;
    movingWidth = Math.round(Math.max(NARROWEST, Math.min(sharp, width * Math.sqrt(MOVING_MS / took))));
  }
  last = {...answer, text, drawn: image, frame};
  if ($("status").className === "poor" && !lost) say("");
  paint();
  document.body.dataset.drawings = ++drawings;
  document.body.dataset.frame = last.frame;
  document.body.dataset.sharp = still;
});

// Fit a frame of this aspect into its stage; returns its width, [px].
function layout(aspect) {
  const room = $("frame").parentElement.getBoundingClientRect();
  const width = Math.max(80, Math.floor(Math.min(room.width, room.height * aspect)));
  for (const item of [$("frame"), $("beside").parentElement]) {
    item.style.width = width + "px"; item.style.height = Math.round(width / aspect) + "px";
  }
  for (const item of [view, $("beside")]) { item.style.width = width + "px"; item.style.height = Math.round(width / aspect) + "px"; }
  return width;
}

function resizeTo(canvas, width, height) {
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  return canvas.getContext("2d");
}

function paint() {
  resizeTo(view, last.width, last.height).drawImage(last.drawn, 0, 0);
  const ratio = devicePixelRatio, box = $("frame").getBoundingClientRect();
  const pen = resizeTo(over, Math.round(box.width * ratio), Math.round(box.height * ratio));
  pen.clearRect(0, 0, over.width, over.height);
  const scale = over.width / last.width;
  for (const [x, y, seen] of last.coverage) {
    pen.fillStyle = COVERAGE[seen];
    pen.fillRect(x * scale - 1.5 * ratio, y * scale - 1.5 * ratio, 3 * ratio, 3 * ratio);
  }
  for (const [name, lines] of Object.entries(last.lines)) {
    pen.strokeStyle = COLORS[name];
    pen.lineWidth = ratio * (name === "axis" || name === "contact" || name === "pair" ? 3 : 1.2);
    pen.lineCap = "round";
    pen.beginPath();
    for (const [x0, y0, x1, y1] of lines) { pen.moveTo(x0 * scale, y0 * scale); pen.lineTo(x1 * scale, y1 * scale); }
    pen.stroke();
    if (name === "contact") for (const [x, y] of lines) { pen.beginPath(); pen.arc(x * scale, y * scale, 4 * ratio, 0, 7); pen.fillStyle = COLORS.contact; pen.fill(); }
  }
  $("unseen").replaceChildren(...last.notes.map(text => { const line = document.createElement("p"); line.textContent = text; return line; }));
}

// ---- The recorded video.

let lastFilm = null, filmText = "";
const refilm = latest(async () => {
  if (!motion || !filmed || (motion.scene && compare === "off")) return;
  const text = new URLSearchParams({motion: motion.name, camera: filmed, time: seconds()}).toString();
  if (text !== filmText) {
    if (!filmText) say("reading the video ...");
    const answer = await fetchOrSay("/api/frame?" + text, {});
    lastFilm = await createImageBitmap(await answer.blob());
    if (!filmText) say("");
    filmText = text;
  }
  for (const canvas of [film, $("beside")]) resizeTo(canvas, lastFilm.width, lastFilm.height).drawImage(lastFilm, 0, 0);
  document.body.dataset.film = seconds();
  if (!motion.scene) drawPlain();
});

const comparable = () => atHome && home === filmed;
function refreshCompare() {
  const possible = comparable(), overlaid = compare === "wipe" || compare === "difference";
  $("besides").hidden = compare !== "beside";
  film.hidden = !(overlaid && possible);
  $("images").className = compare === "difference" && possible ? "difference" : "";
  film.style.clipPath = compare === "wipe" ? `inset(0 0 0 ${100 * wipe}%)` : "";
  $("wipe").hidden = !(compare === "wipe" && possible);
  $("wipe").style.left = 100 * wipe + "%";
  $("what").hidden = !overlaid;
  $("what").textContent = !possible ? `R: back to ${filmed}, to compare with its video` : compare === "wipe" ? "twin | video" : "difference of twin and video, 4 times as bright";
  $("recorded").textContent = "video: " + filmed;
  for (const button of document.querySelectorAll("[data-compare]")) button.setAttribute("aria-pressed", button.dataset.compare === compare);
  for (const button of document.querySelectorAll("[data-view]")) button.setAttribute("aria-pressed", atHome && button.dataset.view === home);
}

// ---- Pose, time and view.

function setPose(next, hand) { pose = next; byHand = hand; $("rest").disabled = !hand; refreshSliders(); touch(); }
function poseOfFrame() {
  const {states, scene} = motion;
  if (!scene || !scene.controls) return {joints: [], gripper: 0, theta: 0};
  return states ? {joints: states.joints[frame], gripper: states.gripper[frame], theta: states.theta[frame]} : scene.controls.rest;
}
function setFrame(index) {
  frame = Math.max(0, Math.min(motion.times.length - 1, index));
  scanImage = null;
  if (atHome && motion.scene) T = poseAt(optics(), frame);
  setPose(poseOfFrame(), false);
  refilm(); refreshTime(); remember();
}
function refreshTime() {
  $("scrub").value = frame;
  $("clock").textContent = motion ? `${seconds().toFixed(2)} of ${motion.times.at(-1).toFixed(2)} s` : "";
  $("play").textContent = playing ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", playing ? "pause" : "play");
}
let remembering = 0;
function remember() {
  clearTimeout(remembering);
  remembering = setTimeout(() => {
    const values = {t: seconds().toFixed(2)};
    if (motion.name !== "recording") values.episode = motion.name;
    writeLink(values);
  }, 250);
}
function goHome(name = filmed && motion.cameras[filmed] ? filmed : home) {
  if (!motion.scene) return;
  home = name; atHome = true; pivot = motion.scene.pivot; T = poseAt(optics(), frame);
  if (motion.videos.includes(name)) { filmed = name; refilm(); }
  refreshCompare(); touch();
}
function moveView(next, newPivot = pivot) { T = next; pivot = newPivot; atHome = false; refreshCompare(); touch(); }

function play() {
  if (playing) { playing = null; refreshTime(); return; }
  if (frame >= motion.times.length - 1) setFrame(0);
  playing = {start: performance.now(), from: seconds()};
  refreshTime();
  requestAnimationFrame(advance);
}
function advance() {
  if (!playing) return;
  const now = playing.from + (performance.now() - playing.start) / 1000;
  let index = frame;
  while (index < motion.times.length - 1 && motion.times[index + 1] <= now) index++;
  if (index !== frame) setFrame(index);
  if (index >= motion.times.length - 1) { playing = null; refreshTime(); return; }
  requestAnimationFrame(advance);
}
function step(count) { playing = null; setFrame(frame + count); }

// ---- Controls.

function makeSlider(name, lower, upper, factor, unit, get, set) {
  const box = document.createElement("div"), label = document.createElement("label"), value = document.createElement("output"), input = document.createElement("input");
  box.className = "slider"; input.type = "range"; input.id = "slider-" + name.replace(/\W+/g, "-");
  label.htmlFor = input.id; label.textContent = name;
  input.min = lower; input.max = upper; input.step = (upper - lower) / 400;
  input.oninput = () => { playing = null; setPose(set(+input.value), true); };
  box.append(label, value, input);
  box.refresh = () => { input.value = get(); value.textContent = (get() * factor).toFixed(factor === 1 ? 2 : factor > 100 ? 0 : 1).replace(/^-(0(\.0+)?)$/, "$1") + unit; };
  return box;
}
const unitOf = slides => slides ? [1000, " mm"] : [180 / Math.PI, "°"];
function buildSliders() {
  const controls = motion.scene && motion.scene.controls;
  $("controls").hidden = !controls;
  if (!controls) { $("sliders").replaceChildren(); return; }
  const {theta, joints} = controls;
  const low = Math.min(theta.lower, 0, controls.rest.theta), high = Math.max(theta.upper, controls.rest.theta);
  $("sliders").replaceChildren(
    makeSlider("object joint", low, high, ...unitOf(theta.slides), () => pose.theta, value => ({...pose, theta: value})),
    makeSlider("gripper", 0, 1, 100, " %", () => pose.gripper, value => ({...pose, gripper: value})),
    ...joints.map((joint, k) => makeSlider(joint.name.replaceAll("_", " ").replace(/ joint$/, ""), joint.lower, joint.upper, ...unitOf(joint.slides), () => pose.joints[k], value => ({...pose, joints: pose.joints.map((old, i) => i === k ? value : old)}))));
}
function refreshSliders() { for (const box of $("sliders").children) box.refresh(); }

function makeToggle(set, name, title, color) {
  const label = document.createElement("label"), input = document.createElement("input");
  input.type = "checkbox"; input.checked = set.has(name); input.dataset.toggle = name;
  input.onchange = () => { if (input.checked) set.add(name); else set.delete(name); touch(); };
  label.append(input);
  if (color) { const swatch = document.createElement("span"); swatch.className = "swatch"; swatch.style.background = color; label.append(swatch); }
  label.append(title);
  return label;
}
function makeButton(title, data, act) {
  const button = document.createElement("button");
  button.textContent = title; Object.assign(button.dataset, data); button.onclick = act;
  return button;
}
function buildControls() {
  const {scene, videos, cameras} = motion;
  $("cameras").hidden = $("shown").hidden = !scene;
  $("comparison").hidden = !scene || !videos.length;
  if (scene) {
    for (const name of [...overlays]) if (!scene.overlays.includes(name)) overlays.delete(name);
    $("toggles").replaceChildren(
      ...scene.parts.map(name => makeToggle(parts, name, PARTS[name])),
      ...scene.overlays.map(name => makeToggle(overlays, name, OVERLAYS[name], SWATCHES[name])));
    $("views").replaceChildren(...Object.keys(cameras).map(name => makeButton("Back to " + name, {view: name}, () => goHome(name))));
    // Before the alignment it is unknown where the video's camera stood.
    const modes = cameras[filmed] ? ["off", "beside", "wipe", "difference"] : ["off", "beside"];
    if (!modes.includes(compare)) compare = "off";
    $("compare").replaceChildren(...modes.map(name => makeButton(name, {compare: name}, () => setCompare(name))));
  }
  buildSliders();
}
function setCompare(mode) {
  compare = mode;
  if ((mode === "wipe" || mode === "difference") && !comparable()) goHome(filmed);
  refreshCompare(); refilm(); touch();
}

// ---- The run.

async function loadMotion(name, time, keep = false) {
  say("opening ...");
  const next = await ask("/api/motion?name=" + encodeURIComponent(name));
  const before = {T, pivot, home, atHome, hand: byHand && motion && motion.name === name && pose};
  motion = next; last = null; filmText = "";
  // Draws without an episode are not in the list.
  if (![...$("motion").options].some(option => option.value === name)) $("motion").append(new Option(motion.title, name));
  $("motion").value = name;
  $("scrub").max = motion.times.length - 1;
  filmed = motion.videos.includes(filmed) ? filmed : motion.videos[0];
  frame = nearestFrame(time);
  if (motion.scene) {
    const stays = keep && before.T && motion.cameras[before.home];
    home = stays ? before.home : Object.keys(motion.cameras)[0];
    atHome = stays ? before.atHome : true;
    pivot = stays && !atHome ? before.pivot : motion.scene.pivot;
    T = stays && !atHome ? before.T : poseAt(optics(), frame);
  }
  document.body.classList.toggle("plain", !motion.scene);
  // The bodies that collide in a draw without an episode are what a person wants to see.
  if (motion.title.startsWith("draw ")) overlays.add("colliders");
  buildControls(); refreshNotes(); refreshCompare(); setFrame(frame);
  if (keep && before.hand) setPose(before.hand, true);
  say("");
  if (motion.scene) $("strip").hidden = $("checks").hidden = true;
  else if ($("strip").hidden) showCapture();
}
function refreshNotes() {
  $("notes").replaceChildren(...[...run.notes, motion && motion.note].filter(Boolean).map(text => { const note = document.createElement("p"); note.className = "note"; note.textContent = text; return note; }));
}
function showRun(found) {
  run = found;
  document.querySelector("h1").textContent = run.name;
  document.title = run.name + " – AOMGen";
  $("motion").replaceChildren(...run.motions.map(item => new Option(item.title, item.name)));
  if (motion) $("motion").value = motion.name;
}
let lost = false;
async function poll() {
  try {
    const found = await ask("/api/run");
    if (lost) { lost = false; say(""); }
    const continued = run && found.token !== run.token;
    if (!run || JSON.stringify(found) !== JSON.stringify(run)) { showRun(found); refreshNotes(); }
    if (continued) {
      const [name, time] = [motion ? motion.name : "recording", motion ? seconds() : 0];
      await loadMotion(run.motions.some(item => item.name === name) ? name : "recording", time, true);
      say("the run has changed; the page shows its new state");
    }
  } catch (error) { lost = true; say(error.message, true); }
  setTimeout(poll, POLL_MS);
}

// ---- Start.

$("play").onclick = play; $("back").onclick = () => step(-1); $("on").onclick = () => step(1);
$("scrub").oninput = () => { playing = null; setFrame(+$("scrub").value); };
$("motion").onchange = () => { playing = null; loadMotion($("motion").value, 0).catch(error => { say(error.message, true); if (motion) $("motion").value = motion.name; }); };
$("rest").onclick = () => setPose(poseOfFrame(), false);
window.onresize = () => touch();
function readTime() { const {t, episode} = readLink(); return [episode || "recording", Number(t) || 0]; }
window.onhashchange = () => {
  const [name, time] = readTime();
  if (motion && name === motion.name) { playing = null; setFrame(nearestFrame(time)); }
  else loadMotion(name, time).catch(error => say(error.message, true));
};

buildHeader("Twin");
say("opening the run ...");
ask("/api/run").then(async found => {
  showRun(found);
  const [name, time] = readTime();
  try { await loadMotion(name, time); }
  catch (error) {
    if (name === "recording") throw error;
    await loadMotion("recording", 0);
    say(error.message, true);
  }
}).catch(error => say(error.message, true)).then(() => setTimeout(poll, POLL_MS));
