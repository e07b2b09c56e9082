// Whether pages can be read and used by everybody: axe-core's rules of WCAG A and AA, contrast among them, in both themes.

import { createRequire } from "node:module";

import { keep } from "./browser.mjs";

const axe = createRequire(`${process.env.PANTARAY_BROWSER_MODULES}/`)("axe-core");
const TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"];
let pages = 0;
let pairs = 0;

/** How many pages were looked at, and how many texts had their contrast computed. */
export const looked = () => ({ pages, pairs });

/** Stops the test where the page that is shown breaks a rule, in dark or in light; keeps pictures of both. */
export async function readable(page, name) {
  for (const theme of ["dark", "light"]) {
    await page.emulateMedia({ colorScheme: theme });
    await page.evaluate(axe.source);
    const { violations, passes } = await page.evaluate((tags) => globalThis.axe.run(document, { runOnly: tags, resultTypes: ["violations", "passes"] }), TAGS);
    pages += 1;
    pairs += passes.find(({ id }) => id === "color-contrast")?.nodes.length ?? 0;
    const found = violations.flatMap((rule) => rule.nodes.map((node) => `${rule.id}: ${node.html.slice(0, 160)} (${node.any.concat(node.all, node.none).map(({ message }) => message).join("; ")})`));
    if (found.length > 0) throw new Error(`${name} in the ${theme} theme:\n${found.slice(0, 12).join("\n")}`);
    await keep(page, theme === "dark" ? name : `${name}-light`);
  }
  await page.emulateMedia({ colorScheme: "dark" });
}
