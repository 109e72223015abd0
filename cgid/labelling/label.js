"use strict";
const { percent, scale, labelColour, $, colour, make, canvas, drawShare } = common;
const KEY = location.hash.slice(1), POLL = 1200, MAX_ROWS = 400;
const kept = (name, value) => {
  try {
    if (value === undefined) return localStorage.getItem("cgid-label-" + name);
    localStorage.setItem("cgid-label-" + name, value);
  } catch { /* a browser that keeps nothing */ }
  return null;
};
let words = {}, language = kept("language") || (navigator.language.startsWith("zh") ? "zh" : "en");
const say = word => (words[language] || {})[word] || word;
// -- what the page knows ------------------------------------------------------------------------------------
const page = {
  state: null, r: 0, impacts: [], stretches: [], names: [], version: -1, from: 0, to: 1, selected: -1, drawn: false, order: "random", queue: [], undo: [],
  begin: null, end: null, view: null, detail: null, opinion: false, away: "", outbox: JSON.parse(kept("outbox") || "[]"), error: "", learned: -1, fraction: null, drag: null, saved: {}, early: false,
};
const recording = () => page.state && page.state.recordings[page.r];
const labelOf = one => one[5] || coveredBy(one);
function coveredBy(one) {  // the label of the shortest stretch around an impact
  let found = "", length = Infinity;
  for (const [start, end, label] of page.stretches)
    if (start <= one[1] && one[1] < end && end - start < length) { found = label; length = end - start; }
  return found;
}
function labelKeys() {  // a letter for each label, a digit where it is taken
  const taken = new Set("uzbpo"), keys = new Map();
  (page.state ? page.state.labels : []).forEach((label, k) => {
    const letter = [...label.toLowerCase()].find(one => /[a-z]/.test(one) && !taken.has(one)) || String(k + 1);
    taken.add(letter); keys.set(letter, label);
  });
  return keys;
}
// -- requests -----------------------------------------------------------------------------------------------
async function ask(path, body) {
  const stop = new AbortController(), timer = setTimeout(() => stop.abort(), 8000);
  const headers = { "X-Cgid-Key": KEY };
  if (body) headers["Content-Type"] = "application/json";
  try {
    return await fetch("api/" + path, { method: body ? "POST" : "GET", headers, body: body && JSON.stringify(body), cache: "no-store", signal: stop.signal });
  } finally { clearTimeout(timer); }
}
async function get(path) {
  const answer = await ask(path);
  if (!answer.ok) throw Object.assign(new Error(await reason(answer)), { status: answer.status });
  return answer.json();
}
async function reason(answer) {
  const text = await answer.text();
  try { return JSON.parse(text).error || text; } catch { return text.trim(); }
}
let sending = false;
async function send() {  // labels wait here until they are on the disk
  if (sending) return;
  sending = true;
  while (page.outbox.length) {
    let answer;
    try { answer = await ask("label", page.outbox[0]); } catch { page.away = "away"; break; }
    if (answer.status === 403) { page.away = "key"; break; }
    if (!answer.ok) {
      page.error = await reason(answer);
      if (answer.status !== 409) break;  // a full disk, or a server that ends: once more
    } else page.error = "";
    page.away = "";
    const sent = page.outbox.shift();
    if (sent.r === page.r) page.saved[sent.k ?? "stretch"] = performance.now();
    kept("outbox", JSON.stringify(page.outbox));
  }
  sending = false;
  showStatus();
}
function post(body) {
  page.outbox.push({ by: $("by").value.trim(), ...body });
  kept("outbox", JSON.stringify(page.outbox));
  showStatus();
  send();
}
// -- labelling ----------------------------------------------------------------------------------------------
function label(name, chosen) {
  const one = page.impacts[page.selected];
  if (!one) { page.early = true; showStatus(); return; }  // nobody has seen what it would label
  const how = chosen || (name === "" ? "" : one[7] === "random" || one[7] === "unsure" || page.drawn ? "random" : "picked");
  page.undo.push({ r: page.r, k: one[0], label: one[5], chosen: one[7] });
  one[5] = name; one[7] = how;
  post({ r: page.r, k: one[0], label: name, chosen: how });
  if (page.order === "random" && page.drawn) draw(); else show();
}
function labelStretch(name) {
  if (page.begin === null || page.end === null) return;
  const [start, end] = [page.begin, page.end].map(x => Number(x.toFixed(6))).sort((a, b) => a - b);
  if (end - start < 1e-3) return;
  page.undo.push({ r: page.r, from: start, to: end, label: "", chosen: "" });
  page.stretches = page.stretches.filter(one => Math.abs(one[0] - start) > 1e-6 || Math.abs(one[1] - end) > 1e-6);
  page.stretches.push([start, end, name]);
  post({ r: page.r, from: start, to: end, label: name, chosen: "stretch" });
  page.begin = page.end = null;
  show();
}
function undo() {
  const last = page.undo.pop();
  if (!last) return;
  if ("from" in last) page.stretches = page.stretches.filter(one => one[0] !== last.from || one[1] !== last.to);
  else if (last.r === page.r) { const one = page.impacts[last.k]; one[5] = last.label; one[7] = last.chosen; select(last.k, true); }
  post(last);
  show();
}
const isOpen = one => !one[5] && one[7] !== "unsure";  // also in a stretch, or the sample would not be of all
function draw() {  // the next impact of the random order that has no label
  if (page.queue.length < page.impacts.length) {
    const known = new Set(page.queue), more = page.impacts.map(one => one[0]).filter(k => !known.has(k));
    page.queue.push(...more);
    for (let k = page.queue.length - 1; k > 0; k--) {  // Fisher and Yates
      const other = Math.floor(Math.random() * (k + 1));
      [page.queue[k], page.queue[other]] = [page.queue[other], page.queue[k]];
    }
  }
  const next = page.queue.find(k => isOpen(page.impacts[k]));
  if (next === undefined) { page.drawn = false; show(); return; }
  page.order = "random";
  select(next, true);
}
function ordered() {
  const all = page.impacts.slice();
  if (page.order === "doubtful") {
    const doubt = one => one[8] ? Math.max(...one[8]) : 2;
    all.sort((a, b) => doubt(a) - doubt(b));
  }
  return all;
}
function step(by) {
  const list = ordered(), at = list.findIndex(one => one[0] === page.selected);
  const next = list[Math.min(Math.max(at + by, 0), list.length - 1)];
  if (next) select(next[0], false);
}
function select(k, drawn) {
  page.selected = k; page.drawn = drawn; page.detail = null;
  const one = page.impacts[k];
  if (!one) return;
  if (one[1] < page.from || one[1] > page.to) { const half = (page.to - page.from) / 2; zoomTo(one[1] - half, one[1] + half); }
  show();
  load();
}
let loading = false;
async function load() {  // one at a time: after fast steps the last impact alone is asked for
  if (loading) return;
  loading = true;
  try {
    while (page.impacts[page.selected] && !page.detail) {
      const [r, k] = [page.r, page.selected], detail = await get(`impact?r=${r}&k=${k}`);
      if (page.r === r && page.selected === k) page.detail = detail;
    }
    showOne();
  } catch (error) { fail(error); } finally { loading = false; }
}
// -- the view -----------------------------------------------------------------------------------------------
let viewing = 0;
function zoomTo(from, to) {
  const duration = recording() ? recording().duration : 1, width = Math.min(Math.max(to - from, 1e-3), duration);
  page.from = Math.min(Math.max(from, 0), Math.max(duration - width, 0));
  page.to = page.from + width;
  const number = ++viewing;
  drawOverview();
  setTimeout(() => number === viewing && fetchView(), 30);
}
async function fetchView() {
  const n = Math.round($("overview").getBoundingClientRect().width), at = [page.r, page.from, page.to];
  try {
    const view = await get(`view?r=${at[0]}&from=${at[1]}&to=${at[2]}&n=${n}`);
    if (at[0] === page.r) { page.view = view; drawOverview(); }
  } catch (error) { fail(error); }
}
function zoomBy(factor, at) {
  const one = page.impacts[page.selected], middle = at ?? (one && one[1] > page.from && one[1] < page.to ? one[1] : (page.from + page.to) / 2);
  zoomTo(middle - (middle - page.from) * factor, middle + (page.to - middle) * factor);
}
const timeText = t => t < 120 ? t.toFixed(page.to - page.from < 1 ? 4 : page.to - page.from < 20 ? 2 : 1) + " s"
  : `${Math.floor(t / 3600) ? Math.floor(t / 3600) + ":" : ""}${String(Math.floor(t / 60) % 60).padStart(2, "0")}:${(t % 60).toFixed(page.to - page.from < 20 ? 3 : 0).padStart(page.to - page.from < 20 ? 6 : 2, "0")}`;
function ticks(c, x, from, to, top, height) {
  const rough = (to - from) / 6, power = 10 ** Math.floor(Math.log10(rough)), every = [1, 2, 5, 10].find(k => k * power >= rough) * power;
  c.fillStyle = colour("--soft"); c.textAlign = "center";
  for (let t = Math.ceil(from / every) * every; t <= to; t += every) { c.globalAlpha = .3; c.fillRect(x(t), top, 1, height); c.globalAlpha = 1; c.fillText(timeText(t), Math.min(Math.max(x(t), 14), x(to) - 18), top + height + 12); }
}
function drawOverview() {
  const [c, width, height] = canvas($("overview")), x = scale(page.from, page.to, 0, width), view = page.view;
  const lanes = recording() ? recording().channels : [], lane = (height - 18) / Math.max(lanes.length, 1);
  for (const [start, end, name] of page.stretches) {
    c.globalAlpha = .18; c.fillStyle = colour(labelColour(name)); c.fillRect(x(start), 0, x(end) - x(start), height - 18);
    c.globalAlpha = 1; c.textAlign = "left"; c.fillText(name, Math.max(x(start), 0) + 3, height - 22);
  }
  if (page.begin !== null || page.end !== null) {
    const a = x(page.begin ?? page.end), b = x(page.end ?? page.begin);
    c.globalAlpha = .25; c.fillStyle = colour("--mark"); c.fillRect(Math.min(a, b), 0, Math.max(Math.abs(b - a), 2), height - 18); c.globalAlpha = 1;
  }
  if (view) view.channels.forEach((channel, k) => {
    const most = Math.max(...channel.high.map(Math.abs), ...channel.low.map(Math.abs), 1), n = channel.low.length;
    const y = scale(-most, most, (k + 1) * lane - 2, k * lane + 12), at = scale(0, n, x(view.start), x(view.end));
    c.fillStyle = colour("--wave");
    for (let i = 0; i < n; i++) c.fillRect(at(i), y(channel.high[i]), Math.max(at(i + 1) - at(i), 1), Math.max(y(channel.low[i]) - y(channel.high[i]), 1));
    c.fillStyle = colour("--soft"); c.textAlign = "right";
    c.fillText(`${channel.name} ±${Number((most * channel.scale).toPrecision(2))} ${recording().unit.replace("^2", "²")}`, width - 2, k * lane + 22);
  });
  for (const one of page.impacts) {
    if (one[1] < page.from || one[1] > page.to) continue;
    const name = labelOf(one);
    c.beginPath(); c.arc(x(one[1]), one[2] * lane + 7, one[0] === page.selected ? 6 : 3.5, 0, 7);
    c.fillStyle = c.strokeStyle = name ? colour(labelColour(name)) : colour("--soft");
    if (name) c.fill(); else c.stroke();
    if (one[0] === page.selected) { c.fillStyle = colour("--mark"); c.fillRect(x(one[1]) - .5, 0, 1, height - 18); }
  }
  ticks(c, x, page.from, page.to, 0, height - 18);
  $("range").textContent = `${timeText(page.from)} – ${timeText(page.to)}`;
  $("stretch").textContent = page.begin === null && page.end === null ? say("no stretch") : stretchText();
}
function stretchText() {
  if (page.begin === null || page.end === null) return timeText(page.begin ?? page.end) + " …";
  const [a, b] = [page.begin, page.end].sort((p, q) => p - q), inside = page.impacts.filter(one => one[1] >= a && one[1] < b), votes = {};
  for (const one of inside) if (one[8]) { const name = page.names[one[8].indexOf(Math.max(...one[8]))]; votes[name] = (votes[name] || 0) + 1; }
  const said = Object.entries(votes).map(([name, n]) => `${name} ${n}`).join(", ");
  return `${timeText(a)} – ${timeText(b)}: ${inside.length} ${say("impacts")}` + (said ? ` (${say("model")}: ${said})` : "");
}
function pointerTime(event) {
  const box = $("overview").getBoundingClientRect();
  return page.from + (event.clientX - box.left) / box.width * (page.to - page.from);
}
function pointers() {
  const overview = $("overview");
  overview.addEventListener("pointerdown", event => { overview.setPointerCapture(event.pointerId); page.drag = { at: pointerTime(event), x: event.clientX, stretch: event.shiftKey || event.pointerType === "touch" }; });
  overview.addEventListener("pointermove", event => {
    if (!page.drag || Math.abs(event.clientX - page.drag.x) < 4) return;
    page.begin = page.drag.at; page.end = pointerTime(event);
    drawOverview();
  });
  overview.addEventListener("pointerup", event => {
    const drag = page.drag;
    page.drag = null;
    if (!drag) return;
    if (Math.abs(event.clientX - drag.x) < 4) {
      const t = pointerTime(event), near = page.impacts.reduce((best, one) => Math.abs(one[1] - t) < Math.abs((best ? best[1] : Infinity) - t) ? one : best, null);
      if (near) select(near[0], false);
    } else if (!drag.stretch) {
      const [a, b] = [page.begin, page.end].sort((p, q) => p - q);
      page.begin = page.end = null;
      zoomTo(a, b);
    } else show();
  });
  overview.addEventListener("wheel", event => { event.preventDefault(); zoomBy(event.deltaY > 0 ? 1.25 : .8, pointerTime(event)); }, { passive: false });
}
// -- one impact ---------------------------------------------------------------------------------------------
function line(c, xs, ys) { c.beginPath(); for (let k = 0; k < ys.length; k++) c.lineTo(xs(k), ys[k]); c.stroke(); }
function showOne() {
  const one = page.impacts[page.selected], detail = page.detail;
  $("which").textContent = one ? `${timeText(one[1])} ${recording().channels[one[2]]}${one[5] ? ": " + one[5] : ""}${one[7] ? ` (${say(one[7] === "random" ? "drawn" : one[7])})` : ""}` : say("impacts");
  const shown = one && one[8] && (page.opinion || labelOf(one));
  $("opinion").textContent = !one || !one[8] ? "" : !shown ? `${say("model")}: ${say("hidden")}`
    : page.names.map((name, k) => `${name} ${percent(one[8][k])}`).join(", ") + ` · ${say("novelty")} ${one[9] === null ? "–" : one[9].toFixed(2)}`;
  for (const button of $("labels").children) button.classList.toggle("on", Boolean(one) && button.dataset.label === one[5]);
  const [w, width, height] = canvas($("waveform")), [s, wide, high] = canvas($("spectrum"));
  if (!detail) return;
  const most = Math.max(...detail.samples.map(Math.abs), 1), y = scale(-most, most, height - 18, 6), n = detail.samples.length;
  w.strokeStyle = colour("--wave"); line(w, scale(0, n, 0, width), detail.samples.map(y));
  w.fillStyle = colour("--soft"); w.textAlign = "left";
  w.fillText(`±${Number((most * detail.scale).toPrecision(3))} ${detail.unit.replace("^2", "²")}`, 2, 12);
  const ms = scale(detail.start * 1e3, (detail.start + n * detail.step) * 1e3, 0, width);
  w.textAlign = "center";
  for (let t = 0; t < (detail.start + n * detail.step) * 1e3; t += 20) { w.fillRect(ms(t), height - 18, 1, 4); w.fillText(`${t} ms`, Math.max(ms(t), 14), height - 4); }
  const logs = detail.frequency.map(Math.log10), x = scale(logs[0], logs[logs.length - 1], 0, wide), level = scale(-80, 0, high - 18, 6);
  s.strokeStyle = colour("--gangue"); line(s, k => x(logs[k]), detail.level.map(one => level(Math.max(one, -80))));
  s.fillStyle = colour("--soft"); s.textAlign = "center";
  for (const f of [10, 100, 1000, 10000, 100000]) if (Math.log10(f) > logs[0] && Math.log10(f) < logs[logs.length - 1]) { s.fillRect(x(Math.log10(f)), 0, .5, high - 18); s.fillText(f < 1000 ? `${f} Hz` : `${f / 1000} kHz`, Math.min(x(Math.log10(f)), wide - 20), high - 4); }
  s.textAlign = "left"; s.fillText("0 … −80 dB", 2, 12);
}
let audio = null;
async function play(speed) {
  if (page.selected < 0) return;
  try {
    const answer = await ask(`sound?r=${page.r}&k=${page.selected}`), samples = new Float32Array(await answer.arrayBuffer());
    audio = audio || new AudioContext();
    const buffer = audio.createBuffer(1, samples.length, Math.min(Math.max(recording().rate, 8000), 192000)), source = audio.createBufferSource();
    buffer.copyToChannel(samples, 0);
    source.buffer = buffer; source.playbackRate.value = speed;
    source.connect(audio.destination); source.start();
  } catch (error) { fail(error); }
}
// -- what is shown ------------------------------------------------------------------------------------------
function fail(error) {
  if (error.status === 403) page.away = "key"; else if (error.status) page.error = error.message; else page.away = "away";
  showStatus();
}
function showStatus() {
  const n = page.outbox.length, problem = page.state && page.state.problem;
  if (page.impacts.length) page.early = false;
  $("alarm").textContent = page.away ? say(page.away) : page.error || problem || (page.early ? say("early") : "");
  $("saved").textContent = n ? `${n} ${say("saving")}` : page.state ? `${say("all saved")}: ${page.state.table}` : "";
}
function show() { drawOverview(); showOne(); showRows(); showStatus(); }
function showRows() {
  const body = $("rows"), list = page.order === "random" ? page.impacts : ordered(), at = Math.max(list.findIndex(one => one[0] === page.selected), 0);
  const first = Math.max(Math.min(at - MAX_ROWS / 2, list.length - MAX_ROWS), 0);
  body.replaceChildren();
  for (const one of list.slice(first, first + MAX_ROWS)) {
    const row = make(body, "tr", one[0] === page.selected ? "on" : ""), name = labelOf(one), seen = one[8] && (page.opinion || name);
    row.onclick = () => select(one[0], false);
    make(row, "td").textContent = timeText(one[1]);
    const cell = make(row, "td"), dot = make(cell, "i");
    if (name) dot.style.background = colour(labelColour(name));
    cell.append(name + (one[7] === "unsure" ? "?" : "") + (one[6] ? ` · ${one[6]}` : ""));
    make(row, "td").textContent = seen ? page.names.map((label, k) => `${label} ${percent(one[8][k])}`).slice(-1)[0] : "";
    make(row, "td").textContent = `${one[3]} ${one[4]}`;
  }
  const done = page.impacts.filter(labelOf).length, one = recording();
  $("count").textContent = `${done} ${say("of")} ${page.impacts.length} ${say("labelled")}` + (one && !one.ended ? ` · ${say("reading")} ${percent(one.read / one.duration)}` : "") + (page.state && page.state.n_unsure ? ` · ${say("unsure")} ${page.state.n_unsure}` : "") + (one && one.fault ? ` · ${one.fault}` : "");
  const on = body.querySelector(".on");
  if (on) body.closest(".scroll").scrollTop = on.offsetTop - 120;
}
function showLearning() {
  const learning = page.state.learning, best = learning.best, result = learning.results[best] || learning.results.new || learning.results.corrected;
  const interval = one => `${percent(one.accuracy)} (${one.accuracy_interval_95.map(x => (100 * x).toFixed(0)).join("–")})`;
  $("headline").textContent = !result ? say("none") : result.text ? `${say(best)}: ${result.text}` : `${say(best)}: ${interval(result)}; ${say("alone")}`;
  $("control").textContent = learning.control.join("\n");
  const lines = [];
  for (const [name, one] of Object.entries(learning.results)) {
    lines.push(`${say(name)}: ${say("right")} ${interval(one)}, n = ${one.n}`);
    one.labels.forEach((label, k) => lines.push(`   ${label}: ${one.confusion[k].map((n, j) => `${say("said")} ${one.labels[j]} ${n}`).join(", ")}`));
  }
  for (const [name, why] of Object.entries(learning.why)) lines.push(`${say(name)}: ${why}`);
  $("details").textContent = [...lines, ...learning.notes, ...(page.state.saved.length ? ["→ " + page.state.saved.join(", ")] : [])].join("\n");
  $("reliability").hidden = !result;
  if (result) drawReliability(result.reliability);
  $("save").textContent = say("save " + (result && learning.results[best] ? best : "new"));
  $("save").disabled = !result;
}
function drawReliability(bins) {
  const [c, width, height] = canvas($("reliability")), x = scale(.4, 1, 42, width - 20), y = scale(0, 1, height - 32, 18);
  c.strokeStyle = c.fillStyle = colour("--soft"); c.beginPath(); c.moveTo(x(.4), y(.4)); c.lineTo(x(1), y(1)); c.stroke();
  c.fillText(say("right"), 0, 10); for (const level of [0, .5, 1]) c.fillText(percent(level), 0, y(level) + 4);
  c.textAlign = "center"; c.fillText(say("sure"), width / 2, height - 4); for (const level of [.4, .7, 1]) c.fillText(percent(level), x(level), height - 18);
  c.fillStyle = colour("--mark");
  for (const [confidence, right, n] of bins) { c.beginPath(); c.arc(x(Math.max(confidence, .4)), y(right), 2 + Math.sqrt(n), 0, 7); c.fill(); }
}
function buttons() {
  document.documentElement.lang = language;
  $("language").textContent = language === "en" ? "中文" : "English";
  for (const one of document.querySelectorAll("[data-w]")) one.textContent = say(one.dataset.w);
  for (const one of document.querySelectorAll("[data-key]")) {
    one.textContent = say(one.dataset.key) + (one.dataset.key === "o" ? ": " + say(page.order) : "");
    make(one, "kbd").textContent = { " ": "␣", ArrowLeft: "←", ArrowRight: "→", PageUp: "PgUp", PageDown: "PgDn" }[one.dataset.key] || one.dataset.key;
    one.onclick = () => { press(one.dataset.key); one.blur(); };
  }
  for (const [place, shift] of [["labels", false], ["stretches", true]]) {
    $(place).replaceChildren();
    for (const [key, name] of labelKeys()) {
      const button = make($(place), "button");
      button.textContent = name; button.dataset.label = name; button.style.background = colour(labelColour(name));
      make(button, "kbd").textContent = shift ? "⇧" + key : key;
      button.onclick = () => { press(key, shift); button.blur(); };
    }
  }
  $("titles").replaceChildren(...["time_s", "label", "model", "peak"].map(word => Object.assign(document.createElement("th"), { textContent: say(word) })));
}
// -- keys ---------------------------------------------------------------------------------------------------
const actions = {
  u: () => label("", "unsure"), z: undo, ArrowLeft: () => step(-1), ArrowRight: () => step(1), Enter: draw, " ": () => play(1), b: () => play(1 / 8),
  p: () => { page.opinion = !page.opinion; show(); }, "+": () => zoomBy(.5), "-": () => zoomBy(2), 0: () => zoomTo(0, recording().duration),
  PageUp: () => pan(-.8), PageDown: () => pan(.8), "[": () => mark("begin"), "]": () => mark("end"),
  o: () => { page.order = { random: "time", time: "doubtful", doubtful: "random" }[page.order]; page.drawn = false; buttons(); show(); },
};
function pan(by) { const width = page.to - page.from; zoomTo(page.from + by * width, page.to + by * width); }
function mark(which) {
  const one = page.impacts[page.selected];
  page[which] = one && one[1] >= page.from && one[1] <= page.to ? one[1] + (which === "begin" ? -.005 : .005) : which === "begin" ? page.from : page.to;
  show();
}
function press(key, shift = false) {
  const name = labelKeys().get(key.toLowerCase());
  if (!page.state && /^\w$/.test(key)) label("");
  if (name !== undefined) { if (shift) labelStretch(name); else label(name); return true; }
  const act = actions[key === "=" ? "+" : key.length === 1 && /[A-Z]/.test(key) ? key.toLowerCase() : key];
  if (act) act();
  return Boolean(act);
}
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT)$/.test(event.target.tagName)) return;
  if (event.target.tagName === "BUTTON" && (event.key === "Enter" || event.key === " ")) return;
  if (press(event.key, event.shiftKey)) event.preventDefault();
});
// -- news ---------------------------------------------------------------------------------------------------
let seen = "";
async function refresh() {
  const state = await get("state");
  const first = !page.state, names = page.state ? page.state.labels.join() : "";
  page.state = state; page.away = "";
  const one = recording();
  if (first || names !== state.labels.join()) buttons();
  state.recordings.forEach((each, k) => {
    const option = $("recording").options[k] || $("recording").appendChild(new Option("", k)), isDone = each.ended && each.n && each.done === each.n;
    const text = `${isDone ? "✓ " : ""}${each.name}${each.ended ? ` · ${each.done} ${say("of")} ${each.n}` : " …"}`;
    if (option.text !== text) option.text = text;
  });
  if (first) zoomTo(0, one.duration);
  const news = [page.r, state.version, one.n, state.learning.version].join();
  if (news !== seen) {
    const asked = performance.now(), r = page.r, found = await get(`impacts?r=${r}&since=${page.version}`);
    if (r !== page.r) return;
    for (const each of found.impacts) {  // a label that was not on the disk when this was asked is newer here
      const k = each[0], mine = page.outbox.findLast(one => one.r === r && one.k === k), own = page.impacts[k];
      if (mine) [each[5], each[7]] = [mine.label, mine.chosen];
      else if (own && page.saved[k] > asked) [each[5], each[7]] = [own[5], own[7]];
      page.impacts[k] = each;
    }
    page.version = found.version; page.names = found.labels; seen = news;
    if (!page.outbox.length && !(page.saved.stretch > asked)) page.stretches = found.stretches;
    if (page.selected < 0 && page.impacts.length && one.ended) draw();
    show();
  }
  if (!one.ended || (page.view && page.view.known < one.duration && one.ended)) fetchView();
  if (state.learning.version !== page.learned && one.ended) {
    page.learned = state.learning.version;
    const found = await get(`fraction?r=${page.r}`);
    drawShare($("fraction"), found.shares, found.threshold, found.turns); $("why").textContent = found.why; page.fraction = found;
  }
  showLearning(); showStatus();
  if (page.outbox.length) send();
}
async function poll() {
  try { await refresh(); } catch (error) { fail(error); }
  setTimeout(poll, POLL);
}
function begin() {
  pointers(); buttons();
  $("by").value = kept("by") || "";
  $("by").onchange = () => kept("by", $("by").value);
  $("language").onclick = () => { language = language === "en" ? "zh" : "en"; kept("language", language); buttons(); show(); if (page.state) showLearning(); };
  $("recording").onchange = () => { Object.assign(page, { r: Number($("recording").value), impacts: [], stretches: [], version: -1, selected: -1, queue: [], view: null, learned: -1, saved: {} }); seen = ""; $("recording").blur(); zoomTo(0, recording().duration); };
  $("save").onclick = async () => { const learning = page.state.learning, answer = await ask("save", { which: learning.results[learning.best] ? learning.best : "new" }); page.error = answer.ok ? "" : await reason(answer); refresh().catch(fail); };
  let size = 0;
  addEventListener("resize", () => { clearTimeout(size); size = setTimeout(() => { fetchView(); show(); if (page.state) { showLearning(); if (page.fraction) drawShare($("fraction"), page.fraction.shares, page.fraction.threshold, page.fraction.turns); } }, 150); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { buttons(); show(); });
  poll();
}
fetch("words.json").then(answer => answer.json()).then(found => { words = found; begin(); });
