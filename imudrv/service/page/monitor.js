"use strict";
// Shows the status frames of a service.
const KEPT = 240;  // frames in the plots: a minute at 4 Hz
const values = { rate: [], force: [] };
let frame = null;

function add(parent, name, text, kind) {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  parent.append(made);
  return made;
}
const short = (n) => (n < 1e4 ? String(n) : n < 1e7 ? `${Math.round(n / 1e3)}k` : `${Math.round(n / 1e6)}M`);
const digits = (x) => (x < 10 ? x.toFixed(1) : x.toFixed(0));
const time = (us) => (us < 1000 ? `${digits(us)} µs` : us < 1e6 ? `${digits(us / 1000)} ms` : `${digits(us / 1e6)} s`);
function drawLatency() {  // the heights are logarithmic: one late sample of millions is seen
  const most = Math.log2(1 + Math.max(1, ...frame.latency.map(([, count]) => count)));
  $("latency").replaceChildren();
  for (const [us, count] of frame.latency) {
    const bin = add($("latency"), "div", "");
    add(bin, "span", count ? short(count) : "");
    add(bin, "i", "").style.height = `${4 * Math.log2(1 + count) / most}rem`;
    add(bin, "b", time(us));
  }
}
function draw() {
  drawLabels();
  document.title = label("title");
  const lost = isLost(), gone = frame && frame.kind === "gone";
  $("health").dataset.health = lost || gone ? "fail" : frame ? frame.health : "warn";
  $("main").classList.toggle("old", Boolean(lost || gone));
  if (lost) $("health").textContent = label("lost");
  else if (gone) $("health").textContent = `${label("no_service")}: ${frame.text}`;
  else if (frame) $("health").textContent = `${label(frame.health)}  ${frame.problems[language]}`;
  if (!frame || gone) return;
  $("rows").replaceChildren();
  for (const [name, text, kind] of frame.rows[language]) {
    const row = add($("rows"), "tr", "");
    add(row, "td", name);
    add(row, "td", text, kind);
  }
  drawLatency();
  $("events").textContent = frame.events.join("\n");
  drawPlot($("rate"), values.rate, KEPT, [0, Math.max(1, range(values.rate, 0)[1]), 2]);
  drawPlot($("force"), values.force, KEPT, [...range(values.force, 1), 2]);
}
live({
  acting() {},
  gone(content) {
    frame = content;
    draw();
  },
  status(content) {
    frame = content;
    for (const id of ["rate", "force"]) keep(values[id], content[id], KEPT);
    draw();
  },
}, draw);
