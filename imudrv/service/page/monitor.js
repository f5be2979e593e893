"use strict";
// Shows the status frames of a service.
const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token") || "";
const KEPT = 240;  // frames in the plots: a minute at 4 Hz
const values = { rate: [], force: [] };
let hello = null, frame = null, socket = null, language = "en";
const label = (name) => (hello ? hello.labels[language][name] : "");

function add(parent, name, text, kind) {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  parent.append(made);
  return made;
}
function plot(id) {
  const canvas = $(id), scale = devicePixelRatio || 1, style = getComputedStyle(document.documentElement);
  const w = canvas.clientWidth * scale, h = canvas.clientHeight * scale, least = 1;
  [canvas.width, canvas.height] = [w, h];
  let low = Math.min(...values[id]), high = Math.max(...values[id]);
  if (id === "rate") low = 0;
  if (high - low < least) [low, high] = id === "rate" ? [0, least] : [(low + high - least) / 2, (low + high + least) / 2];
  const pen = canvas.getContext("2d"), room = 46 * scale;
  pen.fillStyle = style.getPropertyValue("--dim");
  pen.font = `${11 * scale}px sans-serif`;
  pen.fillText(high.toFixed(2), 0, 12 * scale);
  pen.fillText(low.toFixed(2), 0, h - 3);
  pen.strokeStyle = style.getPropertyValue("--do");
  pen.lineWidth = 1.5 * scale;
  pen.beginPath();
  values[id].forEach((v, k) => pen.lineTo(room + (w - room) * (k + KEPT - values[id].length) / KEPT,
    h - 4 - (h - 8) * (v - low) / (high - low)));
  pen.stroke();
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
  for (const one of document.querySelectorAll("[data-label]")) one.textContent = label(one.dataset.label);
  document.documentElement.lang = language.replace("_", "-");
  document.title = label("title");
  const lost = !socket || socket.readyState !== 1, gone = frame && frame.kind === "gone";
  $("health").dataset.health = lost || gone ? "fail" : frame ? frame.health : "warn";
  $("main").classList.toggle("old", Boolean(lost || gone));
  if (lost) $("health").textContent = label("lost");
  else if (gone) $("health").textContent = `${label("no_service")}: ${frame.text}`;
  else if (frame)
    $("health").textContent = `${label(frame.health)}  ${frame.problems[language]}`;
  if (!frame || gone) return;
  $("rows").replaceChildren();
  for (const [name, text, kind] of frame.rows[language]) {
    const row = add($("rows"), "tr", "");
    add(row, "td", name);
    add(row, "td", text, kind);
  }
  drawLatency();
  $("events").textContent = frame.events.join("\n");
  for (const id of ["rate", "force"]) plot(id);
}
const taken = {
  acting() {},
  hello(content) {
    hello = content;
    language = localStorage.getItem("language") || content.language;
    $("language").value = language;
    draw();
  },
  gone(content) {
    frame = content;
    draw();
  },
  status(content) {
    frame = content;
    for (const id of ["rate", "force"]) {
      values[id].push(frame[id]);
      if (values[id].length > KEPT) values[id].shift();
    }
    draw();
  },
};
$("language").onchange = (event) => {
  language = event.target.value;
  localStorage.setItem("language", language);
  draw();
};
function connect() {
  socket = new WebSocket(`${location.origin.replace("http", "ws")}/ws?token=${encodeURIComponent(token)}`);
  socket.onmessage = (event) => {
    const content = JSON.parse(event.data);
    taken[content.kind](content);
  };
  socket.onclose = () => {
    draw();
    setTimeout(connect, 1000);
  };
}
connect();
