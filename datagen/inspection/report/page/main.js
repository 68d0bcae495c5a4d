// SPDX-License-Identifier: MIT
// Fills the page and shows what the address names: #views, #view/CONFIGURATION/VIEW, #view/CONFIGURATION/VIEW@X,Y, each
// optionally followed by ?method=METHOD, which shows the method's predictions.
"use strict";

(() => {
  const report = document.getElementById("report"), viewer = document.getElementById("viewer");
  if (!REPORT.summary || !REPORT.views || !REPORT.predictions) {
    report.prepend(REPORT.element("p", { class: "notice", text: "data/summary.js, data/views.js or data/predictions.js is missing: write the report again." }));
    return;
  }
  REPORT.overview.fill(REPORT.summary);
  REPORT.gallery.fill(REPORT.views, REPORT.summary.findings);
  REPORT.compare.fill();

  function decoded(hash) {
    try {
      return decodeURIComponent(hash);
    } catch (error) {
      if (error instanceof URIError) return hash; // a "%" without two digits; names no view
      throw error;
    }
  }

  let scrolled = 0;
  function go() {
    const match = /^#view\/([^/]+)\/([^@?]+)(?:@(\d+),(\d+))?(?:\?method=([\w-]+))?$/.exec(decoded(location.hash));
    if (!match) {
      const wasViewer = !viewer.hidden;
      viewer.hidden = true;
      report.hidden = document.getElementById("top").hidden = false;
      REPORT.viewer.close();
      const target = document.getElementById(location.hash.slice(1));
      if (target && location.hash !== "#report") target.scrollIntoView();
      else if (wasViewer) window.scrollTo(0, scrolled);
      return;
    }
    if (viewer.hidden) scrolled = window.scrollY;
    report.hidden = document.getElementById("top").hidden = true;
    viewer.hidden = false;
    window.scrollTo(0, 0);
    REPORT.viewer.open(match[1], match[2], match[3] === undefined ? null : { x: Number(match[3]), y: Number(match[4]) }, match[5]);
  }
  window.addEventListener("hashchange", go);
  go();
  document.documentElement.dataset.ready = "true";
})();
