"use strict";
const { percent, scale, labelColour, $, colour, make, canvas, drawShare } = common;
const EMBEDDED = /*DATA*/null;
const OF_THIS_SEAM = /^(anchor|trained_seam)$|gangue/;  // bases of a fraction whose interval is not for any seam
const LATE = 3, TIMEOUT = 2000;  // data are no ground for a decision after LATE [s]; an answer must come within TIMEOUT [ms]
// Pure functions, without the page. `now` is the time of day [s], `waited` the time since new data [s], null in a file.
function shareText(one) {
  if (one.gangue_share === null) return "gangue not known";
  const anySeam = OF_THIS_SEAM.test(one.basis) ? "" : ", any seam";
  return `gangue ${percent(one.gangue_share)} (${percent(one.low)} to ${percent(one.high)}${anySeam})`;
}
function countText(one) {
  const labels = Object.keys(one.labels).sort((a, b) => (a === "unknown") - (b === "unknown") || (a < b ? -1 : 1));
  const counts = labels.map(name => `${name} ${one.labels[name]}`).join(", ") || "no answers yet";
  return `${one.impacts} in the window${one.unknown ? `, ${one.unknown} more unknown` : ""} · since the start: ${counts}`;
}
function durationText(seconds) {
  if (seconds < 100) return `${seconds.toFixed(0)} s`;
  return seconds < 6000 ? `${(seconds / 60).toFixed(0)} min` : `${(seconds / 3600).toFixed(0)} h`;
}
function voidText(data, now, waited) {  // why no decision may be shown
  if (!data) return "no connection to monitor";
  const old = now - data.written, ago = durationText(Math.abs(old));
  if (data.ended) return old < LATE ? "monitor has ended" : `monitor ended ${ago} ago`;
  if (waited > LATE) return `no data from monitor for ${durationText(waited)}`;
  if (old < -LATE) return `the clock of this machine is ${ago} behind that of the monitor: set it`;
  if (old <= LATE) return "";
  if (waited === null) return `no data from monitor for ${ago} (or the clock of this machine is ahead: compare)`;
  return `the clock of this machine is ${ago} ahead of that of the monitor: set it`;
}
function alarmText(data, now, waited) {
  const why = voidText(data, now, waited);
  if (why) return data ? `NO DECISION: ${why}` : why;
  if (data.age === null) return "no samples yet";
  const parts = [];
  if (data.age > 2) parts.push(`no samples taken for ${durationText(data.age)}`);
  if (data.behind > 1) parts.push(`${data.behind.toFixed(1)} s behind`);
  return parts.join(", ");
}
function decisionOf(one, isVoid) {
  const shown = !isVoid && one.ground === "seen" && ["unsure", "draw", "shut"].includes(one.decision);
  return shown ? one.decision : "none";
}
function stateText(one, isVoid) {
  const decision = decisionOf(one, isVoid);
  if (decision === "none") return !isVoid && one.ground === "seen" ? "NO EVIDENCE" : "NO DECISION";
  return { unsure: "NOT YET SURE", draw: "GO ON", shut: "SHUT" }[decision];
}
function groundText(one, old, isVoid) {  // `old` is the age of the data [s]
  const age = moment => durationText(Math.max(one.time_s - moment + old, 0));
  const words = { seen: "sensor in order", blind: "BLIND", fault: "FAULTY", wrong_scale: "WRONG SCALE", mostly_unknown: "MOSTLY UNKNOWN", unproven: "MODEL UNPROVEN", stopped: "STREAM STOPPED" };
  const known = isVoid ? `last known: ${words[one.ground]}` : `${words[one.ground]} for ${age(one.ground_since_s)}`;
  const parts = [known + (one.reason ? `: ${one.reason}` : "")];
  parts.push(...(one.findings || []));
  if (one.last_sound_s !== null) parts.push(`last valid sample ${age(one.last_sound_s)} ago`);
  if (one.last_identified_s !== null) parts.push(`last identified impact ${age(one.last_identified_s)} ago`);
  return parts.join(" · ");
}
function outletText(one) {
  return `${one.name}: ${one.up ? "up" : "away"}, ${one.passed} delivered, ${one.dropped} dropped`;
}
function unitText(unit) { return unit.replace(/\^2|\*\*2/, "²"); }
function samples(wave) { return [wave.low, wave.high].map(values => values.map(value => value * wave.scale)); }
// The page.
function drawWave(element, data, wave, answers) {
  const [c, width, height] = canvas(element), { start, step } = data.waveform;
  const [low, high] = samples(wave), n = low.length;
  if (!n) return;
  const least = Math.min(...low, 0), most = Math.max(...high, 0);
  const x = scale(0, n, 0, width), y = scale(least, most, height - 18, 16);
  c.fillStyle = colour("--wave");
  for (let k = 0; k < n; k++)
    c.fillRect(x(k), y(high[k]), Math.max(width / n, 1), Math.max(y(low[k]) - y(high[k]), 1));
  for (const [time, label] of answers) {
    if (time < start) continue;
    c.fillStyle = colour(labelColour(label));
    c.beginPath(); c.arc(x((time - start) / step), 8, 4, 0, 7); c.fill();
  }
  c.fillStyle = colour("--soft");
  c.fillText(`${start.toFixed(1)} s`, 0, height - 4);
  c.textAlign = "right"; c.fillText(`${(start + n * step).toFixed(1)} s`, width, height - 4);
  c.textAlign = "center"; c.fillText(`${Number(least.toPrecision(3))} to ${Number(most.toPrecision(3))} ${unitText(data.unit)}`, width / 2, height - 4);
}
const cards = new Map();
function card(name) {
  if (cards.has(name)) return cards.get(name);
  const own = { section: make(document.querySelector("main"), "section") };
  const top = make(own.section, "div", "top");
  own.title = make(top, "h2"); own.title.textContent = "channel " + name;
  own.state = make(top, "span", "state");
  own.ground = make(own.section, "div", "soft");
  own.share = make(own.section, "div", "share");
  own.counts = make(own.section, "div", "soft counts");
  own.wave = make(own.section, "canvas"); own.history = make(own.section, "canvas");
  const key = make(own.section, "div", "soft key");
  for (const label of ["coal", "gangue", "other or unknown"]) {
    make(key, "i").style.background = `var(${labelColour(label)})`;
    key.append(label);
  }
  cards.set(name, own);
  return own;
}
function show(data) {
  $("source").textContent = data.source;
  $("clock").textContent = `${data.time.toFixed(1)} s of the stream`;
  $("outlets").textContent = data.outlets.map(outletText).join(" · ");
  for (const one of data.supports) card(one.channel);  // all, before a picture takes its width
  for (const one of data.supports) {
    const own = card(one.channel), waves = data.waveform.channels;
    own.share.textContent = shareText(one); own.counts.textContent = countText(one);
    const wave = waves.find(w => w.name === one.channel) || (data.supports.length === 1 ? waves[0] : undefined);
    own.wave.hidden = !wave;
    if (wave) drawWave(own.wave, data, wave, one.answers);
    drawShare(own.history, one.shares, data.threshold, one.turns);
  }
}
let last = null, newAt = 0;  // the last data, and when they were requested by the stopwatch [ms]
function judge() {  // by its own timer: a stopped monitor never answers
  const now = Date.now() / 1000, waited = EMBEDDED ? null : (performance.now() - newAt) / 1000;
  const isVoid = voidText(last, now, waited) !== "", alarm = alarmText(last, now, waited);
  document.body.className = isVoid ? "void" : "";
  if ($("alarm").textContent !== alarm) $("alarm").textContent = alarm;
  for (const one of last ? last.supports : []) {
    const own = card(one.channel);
    own.state.textContent = stateText(one, isVoid); own.state.className = "state " + decisionOf(one, isVoid);
    own.ground.textContent = groundText(one, Math.max(now - last.written, 0), isVoid);
  }
}
function take(data, askedAt) {
  if (!last || data.written !== last.written) newAt = askedAt;
  last = data;
  show(data);
  judge();
}
async function poll() {
  const askedAt = performance.now(), stop = new AbortController(), timer = setTimeout(() => stop.abort(), TIMEOUT);
  try {
    take(await (await fetch("state.json", { cache: "no-store", signal: stop.signal })).json(), askedAt);
  } catch { /* judge() tells */ }
  clearTimeout(timer);
  setTimeout(poll, 400);
}
setInterval(judge, 250);
document.addEventListener("visibilitychange", judge);
if (EMBEDDED) { setTimeout(() => location.reload(), EMBEDDED.ended ? 5000 : 1000); take(EMBEDDED, 0); } else poll();
