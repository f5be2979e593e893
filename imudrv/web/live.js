"use strict";
// What the pages have in common: the connection to the server, the language, and plots. A page calls `live`.
const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token") || "";
let hello = null, language = "en", socket = null;

const label = (name) => (hello ? hello.labels[language][name] || "" : "");
const isLost = () => !socket || socket.readyState !== 1;

function drawLabels() {
  for (const one of document.querySelectorAll("[data-label]")) one.textContent = label(one.dataset.label);
  for (const one of document.querySelectorAll("[data-title]")) one.title = label(one.dataset.title);
  document.documentElement.lang = language.replace("_", "-");
}
// values: one for each of `kept` frames, the newest last, null where it is not known; scale: [least, most, digits]
function drawPlot(canvas, values, kept, [low, high, digits]) {
  const scale = devicePixelRatio || 1, w = canvas.clientWidth * scale, h = canvas.clientHeight * scale;
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const pen = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
  pen.clearRect(0, 0, w, h);
  if (!Number.isFinite(low)) return;
  const room = 46 * scale, y = (v) => h - 4 - (h - 8) * (v - low) / (high - low);
  pen.fillStyle = style.getPropertyValue("--dim");
  pen.font = `${11 * scale}px sans-serif`;
  pen.fillText(high.toFixed(digits), 0, 12 * scale);
  pen.fillText(low.toFixed(digits), 0, h - 3);
  pen.strokeStyle = style.getPropertyValue("--blue");
  pen.lineWidth = 1.5 * scale;
  pen.beginPath();
  values.forEach((v, k) => v !== null && pen.lineTo(room + (w - room) * (k + kept - values.length) / kept, y(v)));
  pen.stroke();
}
function keep(values, value, kept) {
  values.push(value);
  if (values.length > kept) values.shift();
}
// The range of values with at least a width about its middle.
function range(values, width) {
  const known = values.filter((v) => v !== null), low = Math.min(...known), high = Math.max(...known);
  return high - low < width ? [(low + high - width) / 2, (low + high + width) / 2] : [low, high];
}
// taken: what to do with each kind of message; draw: after the first message, a change of language or of the connection.
function live(taken, draw) {
  const receive = {
    ...taken,
    hello(content) {
      hello = content;
      language = localStorage.getItem("language") || content.language;
      $("language").value = language;
      draw();
    },
  };
  $("language").onchange = (event) => {
    language = event.target.value;
    localStorage.setItem("language", language);
    draw();
  };
  const connect = () => {
    socket = new WebSocket(`${location.origin.replace("http", "ws")}/ws?token=${encodeURIComponent(token)}`);
    socket.onopen = draw;
    socket.onmessage = (event) => {
      const content = JSON.parse(event.data);
      receive[content.kind](content);
    };
    socket.onclose = () => {
      draw();
      setTimeout(connect, 1000);
    };
  };
  connect();
}
