// Trials of two policies side by side, failures first.
"use strict";
let suite = {trials: [], policies: []}, opened = 0, asked = 0;
const PAIR = ["first", "second"];
const chosen = () => PAIR.map(id => Number($(id).value));
buildHeader("Policies");

async function load() {
  try {
    const {suites, problems} = await ask("/policies/suites"), known = suites.map((s, i) => [s, i]).filter(([s]) => s.policies);
    if (problems.length) say(problems.join(" "), true);
    $("note").hidden = known.length > 0; $("content").hidden = $("filters").hidden = !known.length;
    document.body.dataset.loaded = known.length;
    $("suite").replaceChildren(...known.map(([s, i]) => new Option(`${s.name}: ${s.trials} trials, ${s.policies} ${s.policies > 1 ? "policies" : "policy"}`, i)));
    if (known.length) await openSuite();
  } catch (error) { say(error.message, true); }
}
async function openSuite() {
  suite = await ask("/policies/suite?suite=" + $("suite").value);
  PAIR.forEach((id, k) => {
    $(id).replaceChildren(...suite.policies.map((p, i) => new Option(`${p.name} (${p.sees})`, i)));
    $(id).value = Math.min(k, suite.policies.length - 1);
  });
  refresh();
}

function describeResult(result) {
  if (!result) return '<span class="dim">not done</span>';
  const opening = `${Math.round(100 * result.opening) || 0} %`;
  return result.fail_reason ? `<span class="poor" title="${escape(suite.meanings[result.fail_reason] || "")}">✗ ${escape(result.fail_reason.replaceAll("_", " "))}</span> <span class="dim">${opening}</span>` : `<span class="good">✓</span> <span class="dim">${opening}</span>`;
}

function refresh() {
  const policies = chosen().map(i => suite.policies[i]), results = n => policies.map(p => p.trials[n]);
  const failed = result => result && result.fail_reason ? 1 : 0;
  $("summary").innerHTML = `<table class="rows"><tr><th></th><th>policy</th><th class="n">success</th><th class="n">95 % interval</th><th>fails by</th></tr>${policies.map((p, k) => `<tr><td><b style="color:${LINE_COLORS[k]}">&#9632;</b></td><td>${escape(p.name)}<br><span class="dim">${escape(p.sees)}</span></td>
    <td class="n">${p.successes} of ${p.done}<br>${p.done ? (100 * p.successes / p.done).toFixed(0) + " %" : ""}</td><td class="n">${p.interval.map(v => (100 * v).toFixed(0)).join(" to ")} %</td><td>${Object.entries(p.failures).map(([reason, n]) => `${n} ${escape(reason.replaceAll("_", " "))}`).join(", ") || "none"}</td></tr>`).join("")}</table>`;
  const rows = suite.trials.map((trial, n) => ({trial, n, results: results(n)})).filter(row => {
    const count = row.results.reduce((sum, r) => sum + failed(r), 0);
    return $("show").value === "all" || ($("show").value === "failed" ? count > 0 : count === 1);
  });
  // Failures first; those of one policy alone before those of both, because they tell the policies apart.
  const rank = row => [2, 0, 1][row.results.reduce((sum, r) => sum + failed(r), 0)];
  rows.sort((a, b) => rank(a) - rank(b) || a.n - b.n);
  $("trials").innerHTML = `<tr><th>trial</th><th>object</th><th>moved</th><th>setting</th>${policies.map((p, k) => `<th style="color:${LINE_COLORS[k]}">${escape(p.name)}</th>`).join("")}</tr>` + rows.map(row =>
    `<tr class="pick" tabindex="0" data-trial="${row.n}"><td>${row.n}</td><td>${escape(row.trial.asset)}</td><td>${escape(row.trial.place)}</td><td>${escape(row.trial.setting)}</td>${row.results.map(r => `<td>${describeResult(r)}</td>`).join("")}</tr>`).join("");
  for (const row of $("trials").querySelectorAll(".pick")) {
    row.onclick = () => openTrial(Number(row.dataset.trial));
    row.onkeydown = event => { if (event.key === "Enter") openTrial(Number(row.dataset.trial)); };
  }
  if (rows.length) openTrial(rows.some(row => row.n === opened) ? opened : rows[0].n);
}

async function openTrial(number) {
  opened = number;
  const ticket = ++asked, [first, second] = chosen(), values = {suite: $("suite").value};
  for (const row of $("trials").querySelectorAll(".pick")) row.setAttribute("aria-current", Number(row.dataset.trial) === number);
  try {
    const trial = await ask("/policies/trial?" + new URLSearchParams({...values, trial: number, first, second}));
    if (ticket !== asked) return;
    const detail = $("detail");
    detail.innerHTML = `<h3>Trial ${number}</h3><p>${describeDifference(trial)}</p>`;
    [first, second].forEach((policy, k) => {
      if (!trial.filmed[k] || (k && policy === first)) return;
      const video = make("video", {controls: true, muted: true, loop: true, src: "/policies/video?" + new URLSearchParams({...values, policy, trial: number})});
      const caption = make("figcaption", {className: "dim", textContent: `failure of ${suite.policies[policy].name}`});
      detail.append(make("figure", {}, video, caption));
    });
    drawCourses(detail, trial);
    document.body.dataset.opened = number;
  } catch (error) { if (ticket === asked) say(error.message, true); }
}

function describeDifference(trial) {
  const [first, second] = chosen();
  if (first === second) return "Choose another policy to compare with.";
  if (trial.courses.some(c => !c)) return "One of the policies has not done this trial yet.";
  if (!trial.differs) return "Both policies do the same: end effectors stay within 10 mm, openings within 2 % of the planned travel.";
  const {frame, mm, opening} = trial.differs;
  return `They first differ at <b>${((frame + 1) / trial.fps).toFixed(1)} s</b>: the end effectors are ${mm.toFixed(0)} mm apart, the openings ${(100 * Math.abs(opening)).toFixed(0)} % of the planned travel.`;
}

function drawCourses(home, trial) {
  const courses = trial.courses.map((course, k) => ({course, k})).filter(({course}) => course);
  const frames = Math.max(...courses.map(({course}) => course.frames));
  const names = chosen().map(i => suite.policies[i].name);
  const series = [{title: "opening", unit: "% of the planned travel", levels: [{value: 90, name: "limit"}], lines: courses.map(({course, k}) => ({name: names[k], values: course.openings.map(v => 100 * v)}))}];
  if (trial.apart_mm.length) series.push({title: "end effectors apart", unit: "mm", levels: [], lines: [{name: "distance", values: trial.apart_mm}]});
  const move = drawPlots(home, {frames, fps: trial.fps, phases: [], series}, frame => move(frame));
  move(trial.differs ? trial.differs.frame : frames - 1);
}

$("suite").onchange = () => openSuite().catch(error => say(error.message, true));
for (const id of [...PAIR, "show"]) $(id).onchange = refresh;
load();
