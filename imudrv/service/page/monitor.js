"use strict";
// Shows the status frames of a service.
const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token") || "";
const KEPT = 240;  // frames in the plots: a minute at 4 Hz
const values = { rate: [], force: [] };

function add(parent, name, text, kind) {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  parent.append(made);
  return made;
}
function plot(id) {
  const canvas = $(id), scale = devicePixelRatio || 1, style = getComputedStyle(document.documentElement);
  const w = canvas.clientWidth * scale, h = canvas.clientHeight * scale, least = id === "rate" ? 1 : 0.1;
  [canvas.width, canvas.height] = [w, h];
  let low = Math.min(...values[id]), high = Math.max(...values[id]);
  if (high - low < least) [low, high] = [(low + high - least) / 2, (low + high + least) / 2];
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
function head(health, text) {
  $("health").dataset.health = health;
  $("health").textContent = text;
}
const taken = {
  acting() {},
  gone: (frame) => head("fail", `no service: ${frame.text}`),
  status(frame) {
    head(frame.health, `${frame.health.toUpperCase()}  ${frame.reasons.join("; ") || "no problems"}`);
    $("rows").replaceChildren();
    for (const [name, text, kind] of frame.rows) {
      const row = add($("rows"), "tr", "");
      add(row, "td", name);
      add(row, "td", text, kind);
    }
    $("latency").replaceChildren();
    const most = Math.max(...frame.latency_us, 1);
    frame.latency_us.forEach((us, k) => {
      add($("latency"), "span", ["median", "99 %", "99.9 %", "largest"][k]);
      add($("latency"), "i", "").style.width = `${100 * us / most}%`;
      add($("latency"), "span", us.toFixed(0));
    });
    $("events").textContent = frame.events.join("\n");
    for (const id of ["rate", "force"]) {
      values[id].push(frame[id]);
      if (values[id].length > KEPT) values[id].shift();
      plot(id);
    }
  },
};
function connect() {
  const socket = new WebSocket(`${location.origin.replace("http", "ws")}/ws?token=${encodeURIComponent(token)}`);
  socket.onmessage = (event) => {
    const frame = JSON.parse(event.data);
    taken[frame.kind](frame);
  };
  socket.onclose = () => {
    head("fail", "no connection, trying again");
    setTimeout(connect, 1000);
  };
}
connect();
