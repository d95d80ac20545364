// Unpacks the Chromium of @sparticuz/chromium into $TMPDIR and writes a launcher beside it; prints the launcher's path.

import { spawnSync } from "node:child_process";
import { chmodSync, existsSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";

const environment = { ...process.env };
process.env.AWS_EXECUTION_ENV = "AWS_Lambda_nodejs20.x"; // makes the package unpack its libraries, too
const { default: chromium } = await import("@sparticuz/chromium");
const binary = await chromium.executablePath();

const lines = ["#!/bin/sh"];
if (spawnSync(binary, ["--version"], { env: environment }).status !== 0) {
  lines.push(`export LD_LIBRARY_PATH="${join(tmpdir(), "al2023", "lib")}"`); // a bare system, without NSS
}
if (!existsSync("/etc/fonts/fonts.conf")) {
  const fonts = join(tmpdir(), "fonts");
  writeFileSync(join(fonts, "fonts.conf"), `<fontconfig><dir>${fonts}</dir><cachedir>${fonts}/cache</cachedir></fontconfig>\n`);
  lines.push(`export FONTCONFIG_PATH="${fonts}"`);
}
lines.push(`exec "${binary}" "$@"`, "");
const launcher = join(tmpdir(), "launch");
writeFileSync(launcher, lines.join("\n"));
chmodSync(launcher, 0o755);
const told = spawnSync(launcher, ["--version"], { env: environment, encoding: "utf-8" });
if (told.status !== 0) throw new Error(`the browser does not start: ${told.stderr}`);
console.error(told.stdout.trim());
console.log(launcher);
