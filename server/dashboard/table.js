// A list of any length: the coordinator filters, sorts and pages it, and only the rows in view are there.

import { append, h, put, say } from "/dashboard/dom.js";
import { tellProblem } from "/dashboard/dialog.js";

const PAGE = 100;
const PAGES_MAX = 40;
const AROUND = 6;
/** Milliseconds of drawing in one frame: what is left comes in the next. */
const BITE_MS = 8;
/** Rows are drawn anew this often though nothing of them has changed: they hold ages. */
const AGE_MS = 15_000;

/**
 * `columns`: `{key, name, render(row), sort, className, wide}`; `fetch(offset, limit)` answers `{rows, total}`;
 * `id(row)`; `open(row)`; `selected` called when the selection changes.
 */
export class Table {
  constructor({ columns, fetch, id, open, onSort, onSelect, label, empty }) {
    Object.assign(this, { columns, fetch, id, open, onSort, onSelect, empty });
    this.pages = new Map();
    this.asked = new Set();
    this.total = 0;
    this.generation = 0;
    this.selection = new Set();
    this.cursor = 0;
    this.live = new Map();
    this.frame = 0;
    this.head = h("div", { class: "t-head", role: "row" });
    this.body = h("div", { class: "t-body", role: "rowgroup" });
    this.scroll = h("div", { class: "t-scroll", role: "grid", "aria-label": label, "aria-multiselectable": onSelect ? "true" : null, tabindex: "0", onscroll: () => this.draw(), onkeydown: (event) => this.key(event) },
      this.head, this.body);
    this.none = h("div", { class: "t-none", hidden: true });
    this.element = h("div", { class: "table" }, this.scroll, this.none);
    this.resize = new ResizeObserver(() => { this.measure(); this.draw(); });
    this.resize.observe(this.scroll);
    this.drawHead();
  }

  /** Ends what the table watches. */
  end() {
    this.resize.disconnect();
    cancelAnimationFrame(this.frame);
  }

  measure() {
    this.rowHeight = parseFloat(getComputedStyle(this.element).getPropertyValue("--row")) || 36;
  }

  drawHead(sort, order) {
    const cells = this.columns.map((column) => {
      const is = column.sort && column.sort === sort;
      const attributes = { class: `t-cell ${column.className ?? ""}`, role: "columnheader", "aria-sort": is ? (order === "asc" ? "ascending" : "descending") : null };
      if (!column.sort) return h("span", attributes, column.name);
      return h("span", attributes, h("button", { class: "plain sorter", onclick: () => this.onSort(column.sort) }, column.name, h("span", { "aria-hidden": "true" }, is ? (order === "asc" ? " ▲" : " ▼") : "")));
    });
    put(this.head, this.onSelect && h("span", { class: "t-cell t-check", role: "columnheader" }, h("input", { type: "checkbox", "aria-label": "Select all rows that are loaded", onchange: (event) => this.selectAll(event.target.checked) })), cells);
  }

  /** Forgets everything and starts at the top: another filter or order. */
  async reset() {
    this.generation += 1;
    this.pages.clear();
    this.asked.clear();
    this.selection.clear();
    this.cursor = 0;
    this.scroll.scrollTop = 0;
    this.onSelect?.(this.selection);
    await this.load(0);
    this.draw();
  }

  /** Asks again for what is in view; the rest is asked for when it comes into view. */
  async refresh() {
    const [first, last] = this.range();
    const own = this.generation;
    const wanted = new Set();
    for (let page = Math.floor(first / PAGE); page <= Math.floor(Math.max(first, last - 1) / PAGE); page += 1) wanted.add(page);
    for (const page of this.pages.keys()) if (!wanted.has(page)) this.pages.delete(page);
    this.asked.clear();
    await Promise.all([...wanted].map((page) => this.load(page, true)));
    if (own === this.generation) this.draw();
  }

  async load(page, silent = false) {
    if (this.asked.has(page)) return;
    this.asked.add(page);
    const own = this.generation;
    try {
      const { rows, total } = await this.fetch(page * PAGE, PAGE);
      if (own !== this.generation) return;
      this.pages.set(page, rows);
      this.total = total;
      while (this.pages.size > PAGES_MAX) this.pages.delete(this.pages.keys().next().value);
    } catch (problem) {
      if (!silent) tellProblem(problem, "The list could not be read");
    }
    this.asked.delete(page);
  }

  row(index) {
    return this.pages.get(Math.floor(index / PAGE))?.[index % PAGE];
  }

  /** First row in view and one past the last. */
  range() {
    const height = this.rowHeight;
    const first = Math.max(0, Math.floor(this.scroll.scrollTop / height) - AROUND);
    const last = Math.min(this.total, Math.ceil((this.scroll.scrollTop + this.scroll.clientHeight) / height) + AROUND);
    return [first, last];
  }

  /** Draws soon: once a frame, however often it is asked for. */
  draw() {
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      this.paint();
    });
  }

  /** Changes a row that is in view. */
  patch(id, change) {
    const there = this.live.get(id);
    const rows = there && this.pages.get(Math.floor(there.index / PAGE));
    const at = there ? there.index % PAGE : -1;
    if (!rows?.[at] || this.id(rows[at]) !== id) return;
    rows[at] = change(rows[at]);
    this.draw();
  }

  paint() {
    const start = performance.now();
    const height = this.rowHeight;
    this.body.style.height = `${this.total * height}px`;
    this.scroll.setAttribute("aria-rowcount", this.total);
    const [first, last] = this.range();
    const drawn = new Set();
    for (let index = first; index < last; index += 1) {
      const row = this.row(index);
      if (!row) {
        // Drawn again once for each page that comes, however many of its rows are missing
        const page = Math.floor(index / PAGE);
        if (!this.asked.has(page)) this.load(page).then(() => this.draw());
        continue;
      }
      const id = this.id(row);
      drawn.add(id);
      if (performance.now() - start < BITE_MS) this.drawRow(id, row, index, height);
      else this.draw();
    }
    for (const [id, { element }] of this.live) {
      if (drawn.has(id)) continue;
      element.remove();
      this.live.delete(id);
    }
    this.none.hidden = this.total > 0;
    if (this.total === 0) put(this.none, this.empty?.());
  }

  drawRow(id, row, index, height) {
    let there = this.live.get(id);
    if (!there) {
      const element = h("div", { class: "t-row", role: "row", onclick: (event) => this.click(event, id), ondblclick: () => this.open?.(this.live.get(id).row) });
      there = { element, text: "" };
      this.live.set(id, there);
      this.body.append(element);
    }
    there.row = row;
    const text = `${JSON.stringify(row)} ${Math.floor(Date.now() / AGE_MS)}`;
    if (there.text !== text) {
      there.text = text;
      // Whoever has the keyboard on a button of the row keeps it there
      const held = [...there.element.querySelectorAll("a, button, input")].indexOf(document.activeElement);
      const check = this.onSelect && h("span", { class: "t-cell t-check", role: "gridcell" }, h("input", { type: "checkbox", tabindex: "-1", "aria-label": "Select this row", onchange: (event) => this.select(id, event.target.checked) }));
      put(there.element, check, this.columns.map((column) => append(h("span", { class: `t-cell ${column.className ?? ""}`, role: "gridcell", "data-name": column.name }), [column.render(row)])));
      if (held >= 0) there.element.querySelectorAll("a, button, input")[held]?.focus({ preventScroll: true });
    }
    const { element } = there;
    element.style.transform = `translateY(${index * height}px)`;
    element.setAttribute("aria-rowindex", index + 1);
    element.setAttribute("aria-selected", this.selection.has(id));
    element.classList.toggle("cursor", index === this.cursor);
    there.index = index;
    const box = element.querySelector(".t-check input");
    if (box) box.checked = this.selection.has(id);
  }

  click(event, id) {
    if (event.target.closest("a, button, input")) return;
    const there = this.live.get(id);
    this.cursor = there.index;
    if (this.onSelect && (event.ctrlKey || event.metaKey)) this.select(id, !this.selection.has(id));
    this.draw();
  }

  select(id, on) {
    if (on) this.selection.add(id);
    else this.selection.delete(id);
    this.onSelect?.(this.selection);
    this.draw();
  }

  selectAll(on) {
    this.selection.clear();
    if (on) for (const rows of this.pages.values()) for (const row of rows) this.selection.add(this.id(row));
    this.onSelect?.(this.selection);
    this.draw();
  }

  key(event) {
    if (event.target !== this.scroll) return;
    const rows = Math.max(1, Math.floor(this.scroll.clientHeight / this.rowHeight) - 2);
    const steps = { ArrowDown: 1, ArrowUp: -1, PageDown: rows, PageUp: -rows, Home: -this.total, End: this.total };
    const row = this.row(this.cursor);
    if (event.key in steps) this.cursor = Math.max(0, Math.min(this.total - 1, this.cursor + steps[event.key]));
    else if (event.key === " " && row && this.onSelect) this.select(this.id(row), !this.selection.has(this.id(row)));
    else if (event.key === "Enter" && row) this.open?.(row);
    else return;
    event.preventDefault();
    this.showCursor();
  }

  showCursor() {
    const height = this.rowHeight;
    const [top, view] = [this.cursor * height, this.scroll.clientHeight - 2 * height];
    if (top < this.scroll.scrollTop) this.scroll.scrollTop = top;
    else if (top > this.scroll.scrollTop + view) this.scroll.scrollTop = top - view;
    this.draw();
  }
}

/** Keeps a line like "12 of 10,000" true. */
export function sayCount(element, table, noun) {
  say(element, `${table.total.toLocaleString("en-US")} ${noun}${table.total === 1 ? "" : "s"}`);
}
