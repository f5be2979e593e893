"use strict";
// Shows the frames of the session and sends the buttons. Everything that is shown comes from the server.
const SIZE = [150, 200, 100];  // of the unit along X, Y, Z, px
const KEPT = 1200;             // frames in the plots: 60 s at 20 Hz
const TONES = { good: 880, bad: 196, ready: 660, turn: 523 };
let view = null, result = null, reports = null, lines = [], acting = false, ended = false, asked = null;
let sounds = true, audio = null, bells = null, wasReady = false;
const done = new Set();  // steps that were accepted; the verification is a procedure of its own
const history = { rate: [], force: [], stillness: [] };

const inLanguage = (texts) => (texts ? texts[language] || texts.en : "");
const send = (content) => isLost() || socket.send(JSON.stringify(content));

function element(name, attributes, parent, namespace) {
  const made = namespace ? document.createElementNS(namespace, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent.append(made);
  return made;
}
const svg = (name, attributes, parent) => element(name, attributes, parent, "http://www.w3.org/2000/svg");

// The unit on the table: east to the right, north away from the viewer, up.
function box(kind) {
  const made = element("div", { class: `box ${kind}` }, $("world")), [x, y, z] = SIZE;
  const faces = [
    ["Z", x, y, `translateZ(${z / 2}px)`], ["-Z", x, y, `rotateY(180deg) translateZ(${z / 2}px)`],
    ["X", y, z, `rotateY(90deg) rotateZ(-90deg) translateZ(${x / 2}px)`],
    ["-X", y, z, `rotateY(-90deg) rotateZ(90deg) translateZ(${x / 2}px)`],
    ["Y", x, z, `rotateX(90deg) rotateZ(180deg) translateZ(${y / 2}px)`], ["-Y", x, z, `rotateX(-90deg) translateZ(${y / 2}px)`],
  ];
  for (const [name, w, h, transform] of faces) {
    const face = element("div", { class: `face ${name.replace("-", "n")}` }, made);
    face.textContent = name;
    Object.assign(face.style, { width: `${w}px`, height: `${h}px`, left: `${-w / 2}px`, top: `${-h / 2}px`, transform });
  }
  return made;
}
const table = svg("svg", { id: "table", viewBox: "-210 -210 420 420" }, $("world"));
svg("circle", { r: 205 }, table);
for (const [text, x, y] of [["N", 0, -172], ["E", 180, 9], ["S", 0, 192], ["W", -180, 9]])
  svg("text", { x, y }, table).textContent = text;
svg("path", { id: "way" }, table);
svg("path", { id: "tip" }, table);
const ghost = box("ghost"), unit = box("unit");

function place(what, C) {  // C: rows east, north, up in body axes
  const lift = 0.5 * C[2].reduce((sum, c, k) => sum + Math.abs(c) * SIZE[k], 0);
  const sign = [1, -1, 1];  // y of the page points down
  const m = [0, 1, 2].map((column) => [0, 1, 2].map((row) => sign[row] * C[row][column] * sign[column]));
  what.style.transform = `translateZ(${lift}px) matrix3d(${m.map((c) => [...c, 0].join()).join()},0,0,0,1)`;
}
function turned(C, degrees) {  // about up, counter-clockwise
  const c = Math.cos(degrees * Math.PI / 180), s = Math.sin(degrees * Math.PI / 180);
  return [C[0].map((e, k) => c * e - s * C[1][k]), C[0].map((e, k) => s * e + c * C[1][k]), C[2]];
}
const at = (r, degrees) => [-r * Math.sin(degrees * Math.PI / 180), -r * Math.cos(degrees * Math.PI / 180)];
function arc(r, from, to) {
  const end = from + Math.max(-359, Math.min(359, to - from)), [x, y] = at(r, from), [u, v] = at(r, end);
  return `M${x} ${y}A${r} ${r} 0 ${Math.abs(end - from) > 180 ? 1 : 0} ${end > from ? 0 : 1} ${u} ${v}`;
}
function drawPose() {
  const step = hello.steps.find((one) => one.id === view.step), C = view.attitude;
  unit.hidden = !C;
  if (C) place(unit, C);
  const left = view.want === null ? 0 : view.want - (view.angle || 0);
  ghost.hidden = !step;
  if (step) place(ghost, view.phase === "rotate" && C ? turned(C, left) : step.wanted);
  const shows = view.phase === "rotate" && Math.abs(left) > 20;
  for (const id of ["way", "tip"]) $(id).style.display = shows ? "" : "none";
  if (shows) {
    const end = left - Math.sign(left) * 12, [x, y] = at(185, left), [u, v] = at(208, end), [p, q] = at(162, end);
    $("way").setAttribute("d", arc(185, 0, end));
    $("tip").setAttribute("d", `M${x} ${y}L${u} ${v}L${p} ${q}Z`);
  }
}
function drawDial() {
  const angle = view.angle || 0, want = view.want === null ? 180 : view.want;
  $("goal").setAttribute("d", arc(90, want - 5, want + 5));
  $("arc").setAttribute("d", Math.abs(angle) < 0.5 ? "" : arc(90, 0, angle));
  $("degrees").textContent = view.angle === null ? "–" : `${view.angle.toFixed(1)}°`;
  $("speed").textContent = `${Math.abs(view.rate).toFixed(0)} °/s`;
}
function drawPlots() {
  const [, most] = range(history.rate, 0);
  drawPlot($("rate"), history.rate, KEPT, [0, Math.max(5, most), 0]);
  drawPlot($("force"), history.force, KEPT, [...range(history.force, 0.1), 2]);
  drawPlot($("stillness"), history.stillness, KEPT, [0, 1, 2]);
}
function beep(frequency, seconds) {
  if (!sounds) return;
  try {
    audio = audio || new AudioContext();
    const tone = audio.createOscillator(), gain = audio.createGain();
    tone.frequency.value = frequency;
    gain.gain.value = 0.15;
    tone.connect(gain).connect(audio.destination);
    tone.start();
    tone.stop(audio.currentTime + seconds);
  } catch { /* a browser without sound */ }
}
function sound() {
  const ready = view.actions.includes("confirm") && view.phase === "place";
  if (bells !== null && view.bells > bells)
    beep(TONES[view.tone] || TONES.turn, view.tone === "bad" ? 0.8 : 0.25);
  else if (ready && !wasReady) beep(TONES.ready, 0.2);
  bells = view.bells;
  wasReady = ready;
}
const pen = document.createElement("canvas").getContext("2d");
function width(text) {  // in units of the font's size
  pen.font = `800 100px ${getComputedStyle(document.body).fontFamily}`;
  return pen.measureText(text).width / 100;
}
function drawText() {
  const lost = isLost();
  drawLabels();
  $("link").textContent = lost ? `○ ${label("lost")}` : `● ${label(acting ? "acting" : "viewing")}`;
  const big = lost ? label("lost") : ended ? label("over") : view ? inLanguage(view.big) : "";
  $("headline").textContent = big;
  $("headline").style.setProperty("--width", width(big) || 1);
  const why = view ? (view.reasons.length ? view.reasons : view.hints.slice(0, 1)) : [];
  const rejected = view && view.phase === "verdict" && view.tone === "bad";
  const texts = rejected ? [...view.reasons, ...view.hints] : why;
  $("hint").textContent = lost || ended ? "" : texts.slice(0, 2).map(inLanguage).join("\n");
  $("tried").textContent = lost || ended || !view ? "" : view.last_try.map(inLanguage).join("");
  $("big").classList.toggle("rejected", Boolean(rejected) && !lost);
  $("big").dataset.tone = lost ? "bad" : ended ? "good" : view ? view.tone : "wait";
  if (reports) $("report").href = `${reports[language]}?token=${encodeURIComponent(token)}`;
  $("lines").textContent = lines.map(inLanguage).join("\n");
  if (asked) $("asked").textContent = inLanguage(hello.questions[asked.action]);
}
function drawSteps() {
  if (view.step !== "verification") done.clear();
  for (const id of view.accepted) done.add(id);
  const shown = hello.steps.filter((step) => step.id !== "verification" || view.step === step.id);
  $("steps").replaceChildren(...shown.map((step) => {
    const tick = document.createElement("span"), accepted = done.has(step.id);
    tick.className = `step${accepted ? " accepted" : ""}${step.id === view.step ? " now" : ""}`
      + (view.skipped.includes(step.id) ? " skipped" : "");
    tick.textContent = `${accepted ? "✓ " : ""}${step.up}`;
    return tick;
  }));
}
function drawButtons() {
  const asks = Boolean(result && result.table);
  const may = (action) => acting && !ended && !asks && view && view.actions.includes(action);
  for (const action of ["confirm", "redo", "skip", "abort"]) $(action).disabled = !may(action);
  $("back").hidden = !may("back");
  $("give").hidden = !acting;
  $("progress").style.width = `${100 * ((view && view.progress) || 0)}%`;
}
function drawResult() {
  const showing = Boolean((result && result.table) || ended);
  $("live").hidden = showing;
  for (const action of ["confirm", "redo", "skip", "abort"]) $(action).hidden = showing;
  $("outcome").hidden = !showing;
  $("ask").hidden = !(result && result.table) || !acting;
  for (const id of ["arms", "verdicts", "points"]) $(id).replaceChildren();
  if (!result || !result.table) return;
  for (const row of result.table) {
    const line = element("tr", {}, $("arms"));
    for (const cell of row) element(row[0] && row.length > 1 ? "td" : "th", {}, line).textContent = cell;
  }
  if (result.gauge) element("caption", {}, $("arms")).textContent = label("points").replace("{gauge}", result.gauge);
  for (const [mark, text] of result.verdicts) {
    const line = element("li", { class: mark }, $("verdicts"));
    element("b", {}, line).textContent = label(mark);
    line.append(inLanguage(text));
  }
  if (!result.r_mm) return;
  const most = 1.25 * Math.max(...result.r_mm.flat().map(Math.abs), 1);
  for (const [h, v] of [[0, 1], [0, 2]]) {
    const view2 = svg("svg", { viewBox: "-110 -110 220 220" }, $("points"));
    svg("line", { x1: -95, x2: 95, y1: 0, y2: 0 }, view2);
    svg("line", { y1: -95, y2: 95, x1: 0, x2: 0 }, view2);
    svg("text", { x: 100, y: 4 }, view2).textContent = "XYZ"[h];
    svg("text", { x: 0, y: -98 }, view2).textContent = "XYZ"[v];
    result.r_mm.forEach((r, k) => {
      const [x, y] = [95 * r[h] / most, -95 * r[v] / most];
      svg("circle", { cx: x, cy: y, r: 6, fill: ["#d63a30", "#1f9a57", "#2f7df6"][k] }, view2);
      svg("text", { x, y: y - 9 }, view2).textContent = "xyz"[k];
    });
  }
}
function draw() {
  if (!hello) return;
  $("unit").textContent = hello.unit;
  $("simulated").hidden = !hello.simulated;
  drawText();
  drawButtons();
  if (view) drawSteps();
}
function frame() {
  draw();
  drawPose();
  drawDial();
  keep(history.rate, Math.abs(view.rate), KEPT);
  keep(history.force, view.force, KEPT);
  keep(history.stillness, view.stillness, KEPT);
  drawPlots();
  sound();
}
const taken = {
  view(content) {
    if (!hello) return;
    const first = view === null || ended;
    ended = false;
    view = content;
    if (first) {
      lines = [];
      $("report").hidden = true;
      drawResult();
    }
    frame();
  },
  acting(content) {
    acting = content.acting;
    $("take").hidden = acting || !content.free;
    if (!acting) close();
    draw();
    drawResult();
  },
  result(content) {
    result = content;
    if (content.table) beep(TONES.good, 0.3);
    drawResult();
    draw();
  },
  end(content) {
    ended = true;
    lines = content.lines;
    reports = content.reports;
    $("report").hidden = !reports;
    draw();
    drawResult();
  },
};
function act(action) {
  if (!acting || !view || !view.actions.includes(action)) return;
  const content = { action, step: view.step };
  if (!hello.questions[action]) return send(content);
  asked = content;
  $("question").hidden = false;
  draw();
}
function close() {
  asked = null;
  $("question").hidden = true;
}
for (const action of ["confirm", "redo", "skip", "back", "abort"]) $(action).onclick = () => act(action);
$("yes").onclick = () => { if (asked) send(asked); close(); };
$("no").onclick = close;
$("accept").onclick = () => send({ accept: true });
$("reject").onclick = () => send({ accept: false });
$("take").onclick = () => send({ take: true });
$("give").onclick = () => send({ give: true });
$("sound").onclick = () => {
  sounds = !sounds;
  $("sound").setAttribute("aria-pressed", String(sounds));
  $("sound").style.opacity = sounds ? 1 : 0.4;
};
$("theme").onclick = () => {
  const dark = document.documentElement.dataset.theme !== "dark";
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  localStorage.setItem("theme", dark ? "dark" : "light");
};
addEventListener("keydown", (event) => {
  if (asked) {
    if (event.key === "y") $("yes").click();
    else $("no").click();
  } else if (event.key === "Enter" && event.target.tagName !== "BUTTON") act("confirm");
});
function fit() {
  const scene = $("scene");
  $("world").style.setProperty("--scale", Math.min(scene.clientWidth / 500, scene.clientHeight / 470));
}
new ResizeObserver(fit).observe($("scene"));  // which is also hidden and shown again
const wanted = localStorage.getItem("theme")
  || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
document.documentElement.dataset.theme = wanted;
live(taken, () => {
  if (isLost()) acting = false;
  draw();
  drawResult();
});
