// Mouse and keys of the twin page.
"use strict";
let drag = null;
$("frame").onpointerdown = event => {
  if (!motion || !motion.scene) return;
  drag = {x: event.clientX, y: event.clientY, pan: event.button === 2 || event.shiftKey};
  $("frame").setPointerCapture(event.pointerId);
};
$("frame").onpointermove = event => {
  if (!drag) return;
  const dx = event.clientX - drag.x, dy = event.clientY - drag.y, width = $("frame").clientWidth;
  if (!dx && !dy) return;
  drag = {...drag, x: event.clientX, y: event.clientY};
  if (drag.pan) {
    const meters = distanceTo(T, pivot) * optics().width / optics().fx / width;
    moveView(...shift(T, pivot, -dx * meters, -dy * meters, 0));
  } else moveView(orbit(T, pivot, motion.scene.up, -dx * Math.PI / width, -dy * Math.PI / width));
};
$("frame").onpointerup = $("frame").onpointercancel = () => { drag = null; };
$("frame").oncontextmenu = event => event.preventDefault();
$("frame").addEventListener("wheel", event => {
  if (!motion || !motion.scene) return;
  event.preventDefault();
  moveView(zoom(T, pivot, Math.exp(Math.max(-60, Math.min(60, event.deltaY)) / 400)));
}, {passive: false});
$("wipe").onpointerdown = event => { event.stopPropagation(); $("wipe").setPointerCapture(event.pointerId); };
$("wipe").onpointermove = event => {
  if (!event.buttons) return;
  const box = $("frame").getBoundingClientRect();
  wipe = Math.max(0, Math.min(1, (event.clientX - box.left) / box.width));
  refreshCompare();
};
// A button that was clicked keeps no focus, so that the space bar does not press it again.
document.addEventListener("click", event => { const button = event.target.closest("button"); if (button && event.detail) button.blur(); });
const MOVES = {w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0]};
document.addEventListener("keydown", event => {
  const target = event.target, pressed = event.key.toLowerCase();
  if (!motion || event.ctrlKey || event.metaKey || event.altKey || target.tagName === "SELECT") return;
  const slider = target.type === "range" && target !== $("scrub");
  // A key does one thing: arrows move the slider that has the focus, or else step a frame.
  if (pressed === "arrowleft" || pressed === "arrowright") { if (!slider) { event.preventDefault(); step(pressed === "arrowleft" ? -1 : 1); } }
  else if (pressed === " ") { if (target.tagName !== "BUTTON" && target.type !== "checkbox") { event.preventDefault(); play(); } }
  else if (pressed === "r") goHome();
  else if (MOVES[pressed] && motion.scene) {
    const length = 0.04 * distanceTo(T, pivot), [x, y, z] = MOVES[pressed];
    moveView(...shift(T, pivot, x * length, y * length, z * length));
  }
});
