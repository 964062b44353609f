"use strict";
// Interactive page of the motion: disc in 3-D, camera images, curves with one cursor, residuals. No library, no network.
(() => {
  const D = JSON.parse(document.getElementById("motion-data").textContent);
  const $ = (id) => document.getElementById(id);
  const n = D.time.length;
  const view = { turn: -2.2, tilt: 0.9, zoom: 1 };
  let now = 0, playing = false, range = [D.time[0], D.time[n - 1]], printing = false;

  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const colours = () => printing || matchMedia("print").matches
    ? { ink: "#1d2733", soft: "#4d5a67", line: "#cccccc", card: "#ffffff", mark: "#0072b2", second: "#d55e00" }
    : { ink: css("--ink"), soft: css("--soft"), line: css("--line"), card: css("--card"), mark: css("--mark"),
        second: css("--second") };

  function sheet(canvas) { // context in CSS pixels, sharp on any screen
    const ratio = Math.max(1, window.devicePixelRatio || 1);
    const w = canvas.clientWidth || 300, h = canvas.clientHeight || 150;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
    }
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    g.font = "12px system-ui, sans-serif";
    return [g, w, h];
  }

  function rotation([w, x, y, z]) {
    return [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]];
  }
  const place = (R, t, p) => [0, 1, 2].map((i) => R[i][0] * p[0] + R[i][1] * p[1] + R[i][2] * p[2] + t[i]);
  const known = (i) => D.xyz[i][0] !== null;

  function space() {
    const [g, w, h] = sheet($("space")), c = colours();
    const r = D.disc.radius_mm, half = D.disc.thickness_mm / 2;
    const scale = view.zoom * Math.min(w / (3.4 * r), h / (2.7 * r));
    const [st, ct, sl, cl] = [Math.sin(view.turn), Math.cos(view.turn), Math.sin(view.tilt), Math.cos(view.tilt)];
    const flat = (p) => { // orthographic
      const x = p[0] - D.middle[0], y = p[1] - D.middle[1], z = p[2] - 0.35 * r;
      const across = -x * st + y * ct, away = x * ct + y * st;
      return [w / 2 + scale * across, h / 2 - scale * (z * cl - away * sl)];
    };
    const path = (points, closed) => {
      g.beginPath();
      points.forEach((p, i) => { const [u, v] = flat(p); if (i) g.lineTo(u, v); else g.moveTo(u, v); });
      if (closed) g.closePath();
    };
    g.lineWidth = 1; g.strokeStyle = c.line;
    const step = 20, reach = Math.ceil(2 * r / step) * step;
    for (let k = -reach; k <= reach; k += step) {
      const [x, y] = D.middle;
      path([[x + k, y - reach, 0], [x + k, y + reach, 0]]); g.stroke();
      path([[x - reach, y + k, 0], [x + reach, y + k, 0]]); g.stroke();
    }
    const trail = (from, to, colour, width) => {
      g.strokeStyle = colour; g.lineWidth = width; g.beginPath();
      let pen = false;
      for (let i = from; i <= to; i++) {
        const a = D.contact[i];
        if (a[0] === null) { pen = false; continue; }
        const [u, v] = flat([a[0], a[1], 0]);
        if (pen) g.lineTo(u, v); else g.moveTo(u, v);
        pen = true;
      }
      g.stroke();
    };
    trail(0, n - 1, c.line, 1.5);
    trail(Math.max(0, now - Math.round(n / 6)), now, c.second, 2);
    if (!known(now)) { say(g, "no pose in this frame", w / 2, h / 2, c.soft); return; }
    const R = rotation(D.quaternion[now]), t = D.xyz[now];
    const circle = (centre, radius, height) => Array.from({ length: 73 }, (_, k) => {
      const a = 2 * Math.PI * k / 72;
      return place(R, t, [centre[0] + radius * Math.cos(a), centre[1] + radius * Math.sin(a), height]);
    });
    const eye = [ct * cl, st * cl, sl]; // from the scene to the viewer
    const above = R[0][2] * eye[0] + R[1][2] * eye[1] + R[2][2] * eye[2] > 0;
    const upper = circle([0, 0], r, half), lower = circle([0, 0], r, -half);
    const face = above ? upper : lower, other = above ? lower : upper;
    g.fillStyle = "#8b97a3"; g.strokeStyle = "#4d5a67"; g.lineWidth = 1;
    path(other, true); g.fill(); g.stroke();
    for (let k = 0; k < 72; k++) { path([other[k], other[k + 1], face[k + 1], face[k]], true); g.fill(); }
    g.fillStyle = above ? "#f4f4f1" : "#a9b3bd";
    path(face, true); g.fill(); g.stroke();
    if (above) {
      g.fillStyle = "#1d2733";
      for (const dot of D.disc.dots_mm) { path(circle(dot, D.disc.dot_mm / 2, half), true); g.fill(); }
    }
    const a = D.contact[now];
    if (a[0] !== null) {
      const [u, v] = flat([a[0], a[1], 0]);
      g.fillStyle = c.second; g.beginPath(); g.arc(u, v, 4, 0, 2 * Math.PI); g.fill();
    }
    say(g, "grid 20 mm", 8, h - 8, c.soft, "left");
  }

  function say(g, text, x, y, colour, align = "center") {
    g.fillStyle = colour; g.textAlign = align; g.fillText(text, x, y);
  }

  function ticks(low, high, most) {
    const raw = (high - low) / most, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= raw);
    const found = [];
    for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) found.push(v);
    return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
  }

  const LEFT = 58, RIGHT = 10;
  function curve(canvas, series, last) {
    const [g, w, h] = sheet(canvas), c = colours(), bottom = last ? 30 : 8, top = 18;
    const inside = [];
    for (let i = 0; i < n; i++) if (D.time[i] >= range[0] && D.time[i] <= range[1] && series.value[i] !== null) inside.push(i);
    say(g, `${series.name} (${series.unit})`, LEFT, 12, c.ink, "left");
    if (!inside.length) { say(g, "not known here", w / 2, h / 2, c.soft); return; }
    let low = Infinity, high = -Infinity;
    for (const i of inside) { low = Math.min(low, series.value[i]); high = Math.max(high, series.value[i]); }
    const pad = 0.06 * (high - low) || 1e-3 * Math.abs(high) || 1; low -= pad; high += pad;
    const X = (t) => LEFT + (w - LEFT - RIGHT) * (t - range[0]) / (range[1] - range[0]);
    const Y = (v) => top + (h - top - bottom) * (high - v) / (high - low);
    g.strokeStyle = c.line; g.lineWidth = 1;
    const [ys, digits] = ticks(low, high, Math.max(3, (h - 40) / 34));
    for (const v of ys) {
      g.beginPath(); g.moveTo(LEFT, Y(v)); g.lineTo(w - RIGHT, Y(v)); g.stroke();
      say(g, v.toFixed(digits), LEFT - 6, Y(v) + 4, c.soft, "right");
    }
    const [xs, places] = ticks(range[0], range[1], Math.max(2, w / 90));
    for (const t of xs) {
      g.beginPath(); g.moveTo(X(t), top); g.lineTo(X(t), h - bottom); g.stroke();
      if (last) say(g, t.toFixed(places), X(t), h - 14, c.soft);
    }
    if (last) say(g, "time (s)", (LEFT + w) / 2, h - 1, c.soft);
    g.save(); g.beginPath(); g.rect(LEFT, top, w - LEFT - RIGHT, h - top - bottom); g.clip();
    g.globalAlpha = 0.25; g.fillStyle = c.mark; g.beginPath();
    inside.forEach((i, k) => { const y = Y(series.value[i] + 3 * series.sigma[i]); if (k) g.lineTo(X(D.time[i]), y); else g.moveTo(X(D.time[i]), y); });
    for (const i of inside.slice().reverse()) g.lineTo(X(D.time[i]), Y(series.value[i] - 3 * series.sigma[i]));
    g.closePath(); g.fill(); g.globalAlpha = 1;
    g.strokeStyle = c.mark; g.lineWidth = 1.4; g.beginPath();
    let before = -2;
    for (const i of inside) {
      if (i === before + 1) g.lineTo(X(D.time[i]), Y(series.value[i])); else g.moveTo(X(D.time[i]), Y(series.value[i]));
      before = i;
    }
    g.stroke();
    g.strokeStyle = c.second; g.beginPath(); g.moveTo(X(D.time[now]), top); g.lineTo(X(D.time[now]), h - bottom); g.stroke();
    g.restore();
    const v = series.value[now];
    say(g, v === null ? "–" : `${v.toFixed(series.digits)} ± ${series.sigma[now].toPrecision(2)}`, w - RIGHT, 12, c.second, "right");
  }

  function residuals() {
    const [g, w, h] = sheet($("residuals")), c = colours();
    const size = Math.min(h - 44, (w - 30) / 2), reach = D.residual_reach_px;
    ["left", "right"].forEach((name, camera) => {
      const x0 = w / 2 + (camera ? 8 : -8 - size), y0 = 22, mid = [x0 + size / 2, y0 + size / 2];
      g.strokeStyle = c.line; g.strokeRect(x0, y0, size, size);
      g.beginPath(); g.moveTo(mid[0], y0); g.lineTo(mid[0], y0 + size); g.moveTo(x0, mid[1]); g.lineTo(x0 + size, mid[1]); g.stroke();
      const rms = D.rms_px[now][camera];
      say(g, `${name}: ${rms === null ? "not used" : `rms ${rms.toFixed(4)} px`}`, mid[0], 14, c.ink);
      (D.residual_px[now] || [])[camera]?.forEach((p, k) => {
        if (p[0] === null) return;
        const u = mid[0] + size / 2 * Math.max(-1, Math.min(1, p[0] / reach));
        const v = mid[1] + size / 2 * Math.max(-1, Math.min(1, p[1] / reach));
        g.fillStyle = camera ? c.second : c.mark; g.beginPath(); g.arc(u, v, 3.5, 0, 2 * Math.PI); g.fill();
        say(g, String(k), u + 5, v - 4, c.soft, "left");
      });
    });
    say(g, `observed − projected; edge ${reach.toPrecision(2)} px`, w / 2, h - 6, c.soft);
  }

  let shownPicture = -1;
  function picture() {
    if (!D.pictures.length) return;
    let best = 0;
    D.pictures.forEach((p, k) => { if (Math.abs(p.row - now) < Math.abs(D.pictures[best].row - now)) best = k; });
    if (best !== shownPicture) { $("picture").src = D.pictures[best].uri; shownPicture = best; }
    $("picture-caption").textContent = `frame ${D.frame[D.pictures[best].row]}: the nearest that is kept on this page. Green: fitted rim; blue: dots; diamond: contact`;
  }

  function draw() {
    $("slider").value = now;
    $("slider").setAttribute("aria-valuetext", `${D.time[now].toFixed(4)} s`);
    const q = known(now) ? D.words[now] : D.status[now];
    $("told").textContent = `frame ${D.frame[now]}   t = ${D.time[now].toFixed(4)} s   ${q}`;
    space(); picture(); residuals();
    D.series.forEach((s, k) => curve($(`curve-${k}`), s, k === D.series.length - 1));
  }
  let waiting = false;
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; draw(); }); } };
  const go = (i) => { now = Math.max(0, Math.min(n - 1, Math.round(i))); redraw(); };

  const slower = () => Number($("speed").value);
  let began = 0, from = 0;
  function tick(stamp) {
    if (!playing) return;
    if (!began) { began = stamp; from = D.time[now]; }
    const t = from + (stamp - began) / 1000 / slower();
    let i = now;
    while (i < n - 1 && D.time[i + 1] <= t) i++;
    if (i !== now) go(i);
    if (i >= n - 1) { play(false); return; }
    requestAnimationFrame(tick);
  }
  function play(on) {
    playing = on; began = 0;
    $("play").textContent = on ? "❚❚ pause" : "▶ play";
    if (on) { if (now >= n - 1) now = 0; requestAnimationFrame(tick); }
  }
  $("slider").max = n - 1;
  $("slider").addEventListener("input", (e) => { began = 0; from = 0; go(Number(e.target.value)); });
  $("play").addEventListener("click", () => play(!playing));
  $("speed").addEventListener("change", () => { began = 0; });
  document.addEventListener("keydown", (e) => {
    if (e.target.tagName === "SELECT" || e.target.tagName === "BUTTON") return;
    if (e.key === " ") { e.preventDefault(); play(!playing); }
    if (e.target.tagName === "INPUT") return;
    if (e.key === "ArrowRight") go(now + 1);
    if (e.key === "ArrowLeft") go(now - 1);
  });

  let held = null;
  $("space").addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; e.target.setPointerCapture(e.pointerId); });
  $("space").addEventListener("pointermove", (e) => {
    if (!held) return;
    view.turn -= 0.008 * (e.clientX - held[0]);
    view.tilt = Math.max(0.02, Math.min(1.55, view.tilt + 0.008 * (e.clientY - held[1])));
    held = [e.clientX, e.clientY]; redraw();
  });
  for (const end of ["pointerup", "pointercancel"]) $("space").addEventListener(end, () => { held = null; });
  $("space").addEventListener("wheel", (e) => { e.preventDefault(); view.zoom = Math.max(0.4, Math.min(6, view.zoom * Math.exp(-0.001 * e.deltaY))); redraw(); }, { passive: false });

  D.series.forEach((_, k) => {
    const canvas = $(`curve-${k}`);
    const at = (e) => { const b = canvas.getBoundingClientRect(); return range[0] + (range[1] - range[0]) * (e.clientX - b.left - LEFT) / (b.width - LEFT - RIGHT); };
    const nearest = (t) => { let best = 0; for (let i = 1; i < n; i++) if (Math.abs(D.time[i] - t) < Math.abs(D.time[best] - t)) best = i; return best; };
    let start = null;
    canvas.addEventListener("pointerdown", (e) => { start = e; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointerup", (e) => {
      if (!start) return;
      const [a, b] = [at(start), at(e)].sort((p, q) => p - q);
      if (Math.abs(e.clientX - start.clientX) > 12 && b - a > 3 * (D.time[n - 1] - D.time[0]) / n) range = [Math.max(a, D.time[0]), Math.min(b, D.time[n - 1])];
      else go(nearest(b));
      start = null; redraw();
    });
    canvas.addEventListener("dblclick", () => { range = [D.time[0], D.time[n - 1]]; redraw(); });
  });
  $("whole").addEventListener("click", () => { range = [D.time[0], D.time[n - 1]]; redraw(); });
  addEventListener("resize", redraw);
  matchMedia("(prefers-color-scheme:dark)").addEventListener("change", redraw);
  addEventListener("beforeprint", () => { printing = true; draw(); });
  addEventListener("afterprint", () => { printing = false; draw(); });
  const wanted = Number(new URLSearchParams(location.hash.slice(1)).get("frame"));
  now = Number.isFinite(wanted) && wanted > 0 ? Math.min(n - 1, wanted) : Math.max(0, D.status.findIndex((_, i) => known(i)));
  draw();
  window.motionPage = { go, state: () => ({ now, playing, range: range.slice() }) };
})();
