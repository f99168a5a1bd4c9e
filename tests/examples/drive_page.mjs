// SPDX-License-Identifier: GPL-3.0-or-later
// Opens the web example in Chromium and moves its sliders.
//
// usage: node drive_page.mjs CHROMIUM URL PICTURE [SELECTOR=VALUE …]
//
// The selectors are those of selects, sliders and buttons (without a value), used in their order. Writes a picture of
// the page and prints JSON: state and status of the page, positions, names of the joints, number of sliders, the
// requests that were made, and what went wrong.

import { createRequire } from "node:module";

const packages = createRequire(new URL("../../examples/web/package.json", import.meta.url));
const { chromium } = packages("playwright-core");

const [executablePath, url, picture, ...steps] = process.argv.slice(2);
const args = [
  "--no-sandbox",
  // WebGL by the processor: a machine that tests has no graphics card.
  "--disable-gpu",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--disable-quic",
  "--no-first-run",
  "--disable-background-networking",
  "--disable-component-update",
  "--disable-sync",
];

const browser = await chromium.launch({ executablePath, args });
try {
  const page = await browser.newPage({ viewport: { width: 1120, height: 680 } });
  page.setDefaultTimeout(20_000);
  const [requests, errors] = [[], []];
  page.on("request", (request) => requests.push(request.url()));
  page.on("pageerror", (error) => errors.push(error.message));
  page.on("console", (message) => message.type() === "error" && errors.push(message.text()));
  const settled = () => page.waitForSelector('body:is([data-state="ready"], [data-state="failed"])');

  await page.goto(url);
  await settled();
  for (const step of steps) {
    const [selector, value] = step.split("=");
    const element = page.locator(selector);
    const kind = await element.evaluate(({ localName }) => localName);
    if (kind === "select") await element.selectOption(value);
    else if (kind === "button") await element.click();
    else await element.fill(value);
  }
  await settled();

  const shown = await page.evaluate(() => {
    document.activeElement.blur();
    return {
      state: document.body.dataset.state,
      status: document.getElementById("status").textContent,
      positions: Array.from(globalThis.positions ?? []),
      joints: Array.from(document.getElementById("joint").options, (option) => option.text),
      sliders: document.querySelectorAll("input").length,
    };
  });
  await page.screenshot({ path: picture });
  console.log(JSON.stringify({ ...shown, requests, errors }));
} finally {
  await browser.close();
}
