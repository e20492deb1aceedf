// A capture without a scene: the recorded video, images of the scan with their prompts, and the checks.
"use strict";
const PROMPTS = {robot: "#d1495b", static: "#1f6f8b", moving: "#e8a33d"};
let scanImage = null;

// Without Gaussians the stage shows the recorded video, or a scan image with its prompts.
function drawPlain() {
  $("unseen").replaceChildren();
  const image = scanImage ? scanImage.drawn : lastFilm;
  if (!image) return;
  layout(image.width / image.height);
  const pen = resizeTo(view, image.width, image.height);
  pen.drawImage(image, 0, 0);
  if (!scanImage) return;
  pen.lineWidth = Math.max(2, image.width / 300);
  for (const item of scanImage.prompts) {
    pen.strokeStyle = pen.fillStyle = PROMPTS[item.part];
    if (item.box.length) pen.strokeRect(item.box[0], item.box[1], item.box[2] - item.box[0], item.box[3] - item.box[1]);
    for (const [x, y, on] of item.points) { pen.beginPath(); pen.arc(x, y, 2 * pen.lineWidth, 0, 7); if (on) pen.fill(); else pen.stroke(); }
  }
}

// Without a scene: images of the scan with prompts, and the checks of the capture.
async function showCapture() {
  try {
    const capture = await ask("/api/capture");
    $("strip").hidden = false;
    $("strip").replaceChildren(...capture.images.map((name, index) => {
      const thumb = document.createElement("button"), image = new Image(), caption = document.createElement("em");
      const prompts = capture.prompts.filter(item => item.image === name);
      thumb.className = "thumb"; thumb.title = name; caption.textContent = name;
      image.src = "/api/scan?index=" + index; image.loading = "lazy"; image.alt = name; image.width = Math.round(60 * capture.size[0] / capture.size[1]);
      thumb.append(image, caption);
      if (prompts.length) thumb.append(document.createElement("i"));
      thumb.onclick = async () => {
        for (const other of $("strip").children) other.setAttribute("aria-current", other === thumb);
        await image.decode();
        scanImage = {drawn: image, prompts};
        drawPlain();
      };
      return thumb;
    }));
    redraw();
    $("checks").hidden = false;
    const checking = document.createElement("p");
    checking.textContent = "checking ...";
    $("checks").append(checking);
    const found = await ask("/api/check");
    const facts = document.createElement("p");
    facts.className = "facts"; facts.textContent = found.facts || "";
    checking.replaceWith(...found.warnings.map(text => { const note = document.createElement("p"); note.className = "note"; note.textContent = text; return note; }), facts);
  } catch (error) { say(error.message, true); }
}
