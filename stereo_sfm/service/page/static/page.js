"use strict";
const $ = (id) => document.getElementById(id);
const show = (id, text) => { if ($(id).textContent !== text) $(id).textContent = text; };
const number = (value, digits = 1) => value === null || value === undefined ? "–" : Number(value).toFixed(digits);
const STATES = { running: "good", starting: "warn", lost: "bad", camera_gone: "bad", disk_full: "warn", stopping: "warn" };
let plan = null, planVersion = 0, surface = null;  // pictures under the map
const view = { zoom: 1, x: null, y: null, follow: false, scale: 1 };  // of the plan; centre null: the whole map
const HISTORY_S = 300, history_ = kept();  // what the small plots show, one entry a second
let live = null, map = { version: 0, points: [], path: [] }, last = null, receivedAt = 0, commands = 0;

function kept() {  // by the tab, from before it was loaded again
  onpagehide = () => sessionStorage.setItem("history", JSON.stringify(history_));
  try { return JSON.parse(sessionStorage.getItem("history")) || []; } catch { return []; }
}

async function request(path, options) {
  const response = await fetch(path, options);
  if (response.status === 401) login();
  return response;
}

async function command(name, values = {}) {
  const mine = ++commands, report = (text) => mine === commands && show("reply", text);  // of the newest command
  report("…");
  const headers = { "Content-Type": "application/json", "X-Stereo-Sfm": "1" };
  try {
    const response = await request(`api/command/${name}`, { method: "POST", headers, body: JSON.stringify(values) });
    const reply = await response.json();
    report(reply.text || (reply.ok ? "done" : "refused"));
  } catch { report("the service does not respond"); }
  refresh();
}

function row(table, cells, problem) {
  const tr = table.insertRow();
  for (const cell of cells) {
    const td = tr.insertCell();
    if (cell instanceof Node) td.append(cell); else td.textContent = cell;
    if (problem) td.className = "problem";
  }
}

function button(text, action) {
  const made = document.createElement("button");
  made.textContent = text;
  made.onclick = action;
  return made;
}

function showState(state) {
  const s = state.status, alive = Date.now() - receivedAt < 3000;
  const name = !alive ? "no connection" : s ? s.state : "waiting";
  show("state", name.replace("_", " "));
  $("state").className = `badge ${alive && s ? STATES[s.state] || "warn" : "bad"}`;
  show("reason", alive ? (s ? s.reason : "") : "The service does not respond.");
  show("remedy", alive ? (s ? s.remedy : "") : "Is it running? See the log of its unit.");
  show("source", state.source);
  const recording = s && s.recording !== "off";
  $("record").className = recording ? "on" : "";
  show("record", recording ? `Stop recording (${s.recording})` : "Record");
  $("record").onclick = () => command(recording ? "stop_recording" : "start_recording");
  const p = state.pose;
  show("pose", p ? `x ${number(p.x, 2)} m, y ${number(p.y, 2)} m, heading ${number(p.heading * 180 / Math.PI, 0)}°, `
    + `${p.speed === null ? "–" : number(p.speed, 2)} m/s · ${p.state}${p.reason ? ` (${p.reason})` : ""}`
    + `${p.localized ? " · in the saved map" : ""}` : "no pose yet");
}

function showHealth(state) {
  const h = state.health, table = document.createElement("table"), s = state.status || {};
  table.id = "health";
  if (h) {
    const dropped = Object.entries(h.dropped).filter(([, n]) => n).map(([where, n]) => `${n} ${where}`).join(", ");
    const heat = h.counters.temperature_c;
    row(table, ["Rate", `${number(h.rate_hz)} images a second`]);
    row(table, ["Latency", `${number(h.latency_ms[0])} ms, 95 % below ${number(h.latency_ms[1])} ms`]);
    row(table, ["Dropped images", dropped || "none"], Boolean(dropped));
    if (heat) row(table, ["Camera temperature", `${number(heat, 0)} °C`], heat > 75);
    row(table, ["Disk", `${number(h.disk_free / 1e9)} GB free, recordings ${number(h.recording_bytes / 1e9)} GB`], h.disk_free < 1e9);
    row(table, ["Calibration", h.row_error_px === null ? "not known yet" : `row error ${number(h.row_error_px, 2)} px`], h.row_error_px > 0.5);
    row(table, ["Restarts", String(h.restarts)], h.restarts > 0);
  }
  if (s.recording_problem) row(table, ["Recording", s.recording_problem], true);
  if (s.map_folder) row(table, ["Map saved", s.map_saved_ns ? new Date(s.map_saved_ns / 1e6).toLocaleTimeString() : "not yet"]);
  if ($("health").innerHTML !== table.innerHTML) $("health").replaceWith(table);
}

function showEvents(state) {
  const lines = state.events.map((e) => `${e.level}|${new Date(e.unix_ns / 1e6).toLocaleTimeString()}  ${e.text}`).reverse();
  if ($("events").dataset.lines === lines.join("\n")) return;
  $("events").dataset.lines = lines.join("\n");
  $("events").replaceChildren(...lines.map((line) => {
    const li = document.createElement("li");
    [li.className, li.textContent] = [line.split("|", 1)[0], line.slice(line.indexOf("|") + 1)];
    return li;
  }));
}

function drawPlan(state) {
  const canvas = $("plan"), g = canvas.getContext("2d"), p = state.pose;
  const width = canvas.clientWidth, height = canvas.clientHeight, dots = devicePixelRatio;
  [canvas.width, canvas.height] = [width * dots, height * dots];  // which clears it
  g.scale(dots, dots);
  // the plan has the frame of the saved map, which is that of the poses once they are localized in it
  const s = state.status, extent = state.plan && s && p && (p.localized || s.map_is_new) ? state.plan : null;
  $("plan").dataset.plan = extent ? "shown" : "";
  if (!map.points.length && !map.path.length && !p) return;
  const range = (k) => {  // without the outermost hundredth of the points, but with the whole path
    const sorted = map.points.map((v) => v[k]).sort((a, b) => a - b), cut = Math.floor(sorted.length / 100);
    const inner = sorted.length ? [sorted[cut], sorted[sorted.length - 1 - cut]] : [];
    const walls = !extent ? [] : k ? [extent.y - extent.along_y, extent.y] : [extent.x - extent.along_x, extent.x];
    const values = [...inner, ...walls, ...map.path.map((v) => v[k]), ...(p ? [k ? p.y : p.x] : [])];
    return [Math.min(...values), Math.max(...values)];
  };
  const [x0, x1] = range(0), [y0, y1] = range(1), margin = 24;
  const fit = Math.min((width - 2 * margin) / Math.max(y1 - y0, 2), (height - 2 * margin) / Math.max(x1 - x0, 2));
  const scale = view.scale = fit * view.zoom;
  if (view.follow && p) [view.x, view.y] = [p.x, p.y];
  const [cx, cy] = view.x === null ? [(x0 + x1) / 2, (y0 + y1) / 2] : [view.x, view.y];
  [view.cx, view.cy] = [cx, cy];
  // x forward is up, y left is left
  const at = (x, y) => [width / 2 - (y - cy) * scale, height / 2 - (x - cx) * scale];
  if (extent && plan) {
    g.imageSmoothingEnabled = false;
    g.drawImage(plan, ...at(extent.x, extent.y), extent.along_y * scale, extent.along_x * scale);
  }
  const under = surface && s && p && (p.localized || s.map_is_new) ? surface : null;
  canvas.dataset.surface = under ? "shown" : "";
  if (under) g.drawImage(under.image, ...at(under.x, under.y), under.along_y * scale, under.along_x * scale);
  for (const [x, y, z] of map.points) {
    g.fillStyle = `hsl(${Math.max(0, Math.min(240, 200 - 80 * z))} 60% 50%)`;
    g.fillRect(...at(x, y), 2, 2);
  }
  g.strokeStyle = "#3b82f6"; g.lineWidth = 2; g.beginPath();
  for (const [x, y] of map.path) g.lineTo(...at(x, y));
  g.stroke();
  if (p) {
    g.save(); g.translate(...at(p.x, p.y)); g.rotate(-p.heading);
    g.fillStyle = p.tracked ? "#f97316" : "#c0271a";
    g.beginPath(); g.moveTo(0, -12); g.lineTo(8, 9); g.lineTo(0, 4); g.lineTo(-8, 9); g.fill(); g.restore();
  }
  const metres = [1, 2, 5, 10, 20, 50].find((m) => m * scale > 60) || 100;
  g.strokeStyle = g.fillStyle = "#888"; g.beginPath(); g.moveTo(12, height - 12);
  g.lineTo(12 + metres * scale, height - 12); g.stroke(); g.font = "14px system-ui";
  g.fillText(`${metres} m`, 12, height - 18);
}

function redraw() { if (last) drawPlan(last); }

const zoomed = (factor) => Math.max(0.5, Math.min(40, view.zoom * factor));

function zoom(factor) {
  view.zoom = zoomed(factor);
  redraw();
}

function move([fromX, fromY], [toX, toY], factor = 1) {  // pixels: what lies at the one comes to the other
  if (view.cx === undefined) return;
  const { clientWidth: width, clientHeight: height } = $("plan"), scale = view.scale * zoomed(factor) / view.zoom;
  view.x = view.cx - (fromY - height / 2) / view.scale + (toY - height / 2) / scale;
  view.y = view.cy - (fromX - width / 2) / view.scale + (toX - width / 2) / scale;
  view.zoom = zoomed(factor);
  follow(false);
}

const ARROW_PX = 40, ARROWS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [1, 0], ArrowRight: [-1, 0] };
const fingers = new Map();  // those on the plan, by pointer: one scrolls the page, two move and zoom the plan
const span = ([a, b]) => ({ at: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], size: Math.hypot(a[0] - b[0], a[1] - b[1]) });

function fingerMoved(event) {
  const before = span([...fingers.values()]);
  fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  const now = span([...fingers.values()]);
  move(before.at, now.at, now.size / Math.max(before.size, 1));
}

function follow(on) {
  $("follow").checked = view.follow = on;
  if (on && view.zoom < 2) view.zoom = 4;
  redraw();
}

function wholeMap() {
  [view.zoom, view.x, view.y] = [1, null, null];
  follow(false);
}

function prepareView() {
  const canvas = $("plan");
  canvas.onwheel = (event) => { event.preventDefault(); zoom(event.deltaY < 0 ? 1.2 : 1 / 1.2); };
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (event.pointerType === "touch") fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  };
  canvas.onpointermove = (event) => {
    if (event.pointerType !== "touch") { if (event.buttons) move([0, 0], [event.movementX, event.movementY]); }
    else if (fingers.size === 2 && fingers.has(event.pointerId)) fingerMoved(event);
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => fingers.delete(event.pointerId);
  canvas.addEventListener("touchmove", (event) => event.touches.length > 1 && event.preventDefault(), { passive: false });
  canvas.onkeydown = (event) => {
    if (!Object.hasOwn(ARROWS, event.key) || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    move([0, 0], ARROWS[event.key].map((way) => way * ARROW_PX));
  };
  $("zoom-in").onclick = () => zoom(1.5);
  $("zoom-out").onclick = () => zoom(1 / 1.5);
  $("fit").onclick = wholeMap;
  $("follow").onchange = () => follow($("follow").checked);
}

function plot(name, key, text) {
  const figure = document.createElement("figure"), caption = document.createElement("figcaption");
  caption.textContent = `${name}: ${text}`;
  const most = Math.max(...history_.map((entry) => entry[key]), 1e-9), place = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(place, "svg"), path = document.createElementNS(place, "path");
  svg.setAttribute("viewBox", `0 0 ${HISTORY_S} 100`);
  svg.setAttribute("preserveAspectRatio", "none");
  const from = history_[history_.length - 1].at - HISTORY_S;
  path.setAttribute("d", history_.map((e, k) => `${k ? "L" : "M"}${e.at - from} ${96 - 92 * e[key] / most}`).join(""));
  svg.append(path);
  figure.append(caption, svg);
  return figure;
}

function showHistory(state) {
  const h = state.health, now = Math.floor(Date.now() / 1000);
  if (!h || (history_.length && history_[history_.length - 1].at === now)) return;
  const dropped = Object.values(h.dropped).reduce((a, b) => a + b, 0), speed = state.pose ? state.pose.speed || 0 : 0;
  history_.push({ at: now, rate: h.rate_hz || 0, latency: h.latency_ms[1] || 0, dropped, speed });
  while (history_[0].at <= now - HISTORY_S) history_.shift();
  $("history").replaceChildren(
    plot("Rate", "rate", `${number(h.rate_hz)} Hz`), plot("Latency, 95 %", "latency", `${number(h.latency_ms[1], 0)} ms`),
    plot("Dropped images", "dropped", String(dropped)), plot("Speed", "speed", `${number(speed, 2)} m/s`));
}

const KEYS = { "+": () => zoom(1.5), "-": () => zoom(1 / 1.5), "0": wholeMap, f: () => follow(!view.follow),
  r: () => $("record").click() };

document.onkeydown = (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || $("all").hidden || $("player").open) return;
  if (["INPUT", "SELECT", "TEXTAREA"].includes(event.target.tagName)) return;
  const made = document.querySelector(`[data-key="${CSS.escape(event.key)}"]`);
  if (made) made.click(); else if (Object.hasOwn(KEYS, event.key)) KEYS[event.key]();
};

function refreshPlan(extent) {
  if (!extent || extent.version === planVersion) return;
  planVersion = extent.version;
  const loaded = new Image();
  loaded.onload = () => { plan = loaded; };
  loaded.src = `api/floor_plan.png?version=${extent.version}`;
}

async function refreshSurface() {
  const response = await request("api/surface"), found = response.status === 200 ? await response.json() : null;
  if (!found) surface = null;
  if (!found || (surface && surface.version === found.version)) return;
  const image = new Image();
  image.onload = () => { surface = { ...found, image }; };
  image.src = `api/surface.png?version=${found.version}`;
}

async function refreshMap(version) {
  if (version !== map.version) map = await (await request("api/map")).json();
}

const clock = (seconds) => `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
const played = { id: "", times: [], at: 0, timer: 0 };  // the recording in the player
const thumbnail = (id, k) => `api/recordings/${encodeURIComponent(id)}/thumbnails/${k}`;

function showFrame(k) {
  played.at = Math.max(0, Math.min(played.times.length - 1, k));
  $("seek").value = played.at;
  $("frame").src = thumbnail(played.id, played.at);
  show("time", `${clock(played.times[played.at])} of ${clock(played.times[played.times.length - 1])}`);
}

function pause() {
  clearTimeout(played.timer);
  played.timer = 0;
  show("play", "Play");
}

function playOn() {
  const next = played.at + 1;
  if (next >= played.times.length) { pause(); return; }
  const wait = (played.times[next] - played.times[played.at]) / Number($("speed").value);
  played.timer = setTimeout(() => { showFrame(next); playOn(); }, 1000 * Math.max(0.05, wait));
  show("play", "Pause");
}

function playOrPause() {
  if (played.timer) { pause(); return; }
  if (played.at === played.times.length - 1) showFrame(0);
  playOn();
}

async function openPlayer(id) {
  const response = await request(`api/recordings/${encodeURIComponent(id)}/timeline`);
  const times = response.ok ? await response.json() : [];
  if (!times.length) { show("reply", `${id} has no images to show yet`); return; }
  [played.id, played.times] = [id, times];
  show("player-title", id);
  $("seek").max = times.length - 1;
  showFrame(0);
  if (!$("player").open) $("player").showModal();
  playOn();
}

function preparePlayer() {
  $("play").onclick = playOrPause;
  $("seek").oninput = () => { pause(); showFrame(Number($("seek").value)); };
  $("close").onclick = () => $("player").close();
  $("player").onclose = pause;
  $("player").onkeydown = (event) => {
    if (event.target.tagName === "SELECT" || event.key === "Escape") return;
    if (event.target.tagName === "BUTTON" && event.key === " ") return;  // the space bar is a click on it
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (event.key === " ") playOrPause(); else if (step) { pause(); showFrame(played.at + step); } else return;
    event.preventDefault();
  };
}

async function refresh() {
  try {
    await refreshSurface();
    const rows = await (await request("api/recordings")).json(), table = document.createElement("table");
    table.id = "recordings";
    for (const r of Array.isArray(rows) ? rows : []) {
      const open = button("files", () => listFiles(r.id)), actions = document.createElement("span");
      actions.append(button("play", () => openPlayer(r.id)), open, button("delete", () => confirm(`Delete ${r.id}?`) && command("delete_recording", { id: r.id })));
      const length = `${clock(r.seconds)} min`, small = document.createElement("img");
      [small.className, small.alt, small.loading] = ["thumbnail", "", "lazy"];
      small.onerror = () => { small.hidden = true; };
      if (!r.recording) small.src = thumbnail(r.id, 0); else small.hidden = true;
      const lean = r.segments - r.with_images;
      const size = `${length}, ${number(r.bytes / 1e6, 0)} MB, ${r.mode}${lean ? `, ${lean} of ${r.segments} segments without images` : ""}`;
      row(table, [small, `${r.id}${r.marked ? " ★" : ""}`, size, r.verdict, actions]);
    }
    if (!table.rows.length) row(table, ["none"]);
    $("recordings").replaceWith(table);
    if (!$("settings").contains(document.activeElement)) showSettings(await (await request("api/settings")).json());
  } catch { /* the next state shows that the service does not respond */ }
}

async function listFiles(id) {
  const place = `api/recordings/${encodeURIComponent(id)}`, files = await (await request(place)).json();
  $("files").replaceChildren(...files.map((file, i) => {
    const li = document.createElement("li"), a = document.createElement("a");
    [a.href, a.textContent, a.download] = [`${place}/${i}`, `${file.name} (${number(file.bytes / 1e6)} MB)`, ""];
    li.append(a);
    return li;
  }));
}

function fieldOf(setting) {
  const change = (value) => command("set_setting", { name: setting.name, value: String(value) });
  if (setting.words.length) {
    const select = document.createElement("select");
    for (const word of setting.words) select.add(new Option(word, word, false, word === setting.value));
    select.onchange = () => change(select.value);
    return select;
  }
  const input = document.createElement("input");
  if (typeof setting.value === "boolean") {
    [input.type, input.checked] = ["checkbox", setting.value];
    input.setAttribute("role", "switch");
    input.onchange = () => change(input.checked);
    return input;
  }
  [input.type, input.value] = [typeof setting.value === "number" ? "number" : "text", setting.value];
  if (setting.least !== null) [input.min, input.max, input.step] = [setting.least, setting.most, "any"];
  input.onchange = () => input.reportValidity() && change(input.value);
  return input;
}

function showSettings(settings) {
  const all = document.createElement("div"), groups = {};
  all.id = "settings";
  for (const setting of settings) {
    if (!groups[setting.group]) {
      const group = groups[setting.group] = document.createElement("fieldset"), legend = document.createElement("legend");
      legend.textContent = setting.group;
      group.append(legend);
      all.append(group);
    }
    const label = document.createElement("label"), name = document.createElement("span"), help = document.createElement("span");
    const value = document.createElement("span");
    label.className = "setting"; help.className = "help";
    name.textContent = setting.label; help.textContent = setting.help;
    value.append(fieldOf(setting), setting.unit ? ` ${setting.unit}` : "");
    label.append(name, value, help);
    groups[setting.group].append(label);
  }
  if (!settings.length) all.textContent = "none may be changed while running";
  $("settings").replaceWith(all);
}

function login() {
  $("login").hidden = false; $("all").hidden = true;
  if (live) { live.close(); live = null; }
}

async function logInWith(token) {
  const headers = { "Content-Type": "application/json" };
  const response = await fetch("login", { method: "POST", headers, body: JSON.stringify({ token }) });
  show("login-reply", response.ok ? "" : (await response.json()).text);
  return response.ok;
}

$("login").onsubmit = async (event) => {
  event.preventDefault();
  if (!await logInWith($("token").value)) return;
  $("token").value = ""; $("login").hidden = true; $("all").hidden = false;
  start();
};

function nextImage() {
  const img = $("image");
  if (document.hidden || !live) return;
  fetch("api/image.jpg").then((response) => response.status === 200 ? response.blob() : null).then((blob) => {
    if (!blob) return;
    const reader = new FileReader();
    reader.onload = () => { img.src = reader.result; };
    reader.readAsDataURL(blob);
  }).catch(() => {});
}

async function start() {
  if (live || (await request("api/map")).status !== 200) return;
  live = new EventSource("api/live");
  live.onmessage = (event) => {
    last = JSON.parse(event.data); receivedAt = Date.now();
    refreshMap(last.map_version); refreshPlan(last.plan);
    showState(last); showHealth(last); showHistory(last); showEvents(last); drawPlan(last);
  };
  refresh();
}

for (const made of document.querySelectorAll("[data-command]")) {
  made.onclick = () => (!made.dataset.ask || confirm(made.dataset.ask)) && command(made.dataset.command);
}
prepareView();
preparePlayer();
setInterval(nextImage, 300);
setInterval(refresh, 10000);
setInterval(() => { if (last) showState(last); if (!live && $("login").hidden) start().catch(() => {}); }, 2000);
async function begin() {  // a link may hold the code for one log-in
  const code = location.hash.slice(1);
  if (code) history.replaceState(null, "", location.pathname);
  if (code.startsWith("once-")) await logInWith(code);
  await start();
}
begin().catch(() => {});
