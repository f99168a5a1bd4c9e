// SPDX-License-Identifier: GPL-3.0-or-later
// Opens the web example in Chromium and moves its sliders.
//
// usage: node drive_page.mjs CHROMIUM URL PICTURE [SELECTOR=VALUE …]
//
// Each selector names a select, a slider, or, without a value, a button or a box to uncheck; in the given order. Writes a
// screenshot of the page. Prints JSON: state and status of the page, vertex positions, names of the joints and controls,
// addresses of the requests, and errors.

import { createRequire } from "node:module";

const packages = createRequire(new URL("../../examples/web/package.json", import.meta.url));
const { chromium } = packages("playwright-core");

const [executablePath, url, picture, ...steps] = process.argv.slice(2);
const args = [
  "--no-sandbox",
  // Render WebGL on the CPU, because test machines have no GPU.
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
  const waitForResult = () => page.waitForSelector('body:is([data-state="ready"], [data-state="failed"])');

  await page.goto(url);
  await waitForResult();
  for (const step of steps) {
    const [selector, value] = step.split("=");
    const element = page.locator(selector);
    const kind = await element.evaluate(({ localName }) => localName);
    if (kind === "select") await element.selectOption(value);
    else if (kind === "button") await element.click();
    else if (!value) await element.setChecked(false);
    else await element.fill(value);
  }
  await waitForResult();

  const pageState = await page.evaluate(() => {
    document.activeElement.blur();
    return {
      state: document.body.dataset.state,
      status: document.getElementById("status").textContent,
      positions: Array.from(globalThis.positions ?? []),
      joints: Array.from(document.getElementById("joint").options, (option) => option.text),
      controls: Array.from(document.querySelectorAll("#controls .slider span"), (span) => span.textContent),
    };
  });
  await page.screenshot({ path: picture });
  console.log(JSON.stringify({ ...pageState, requests, errors }));
} finally {
  await browser.close();
}
