// What all pages share: the header with tabs, requests, and one line for errors.
"use strict";
const TABS = [["/", "Twin"], ["/review", "Review"], ["/coverage", "Coverage"], ["/policies", "Policies"]];
const $ = id => document.getElementById(id);

// Fill <header> with the tabs, the title of the page and the status line.
function buildHeader(title) {
  const header = document.querySelector("header"), heading = document.createElement("h1");
  const tabs = document.createElement("nav"), status = document.createElement("span");
  heading.textContent = title;
  for (const [path, name] of TABS) {
    const link = document.createElement("a");
    link.href = path; link.textContent = name;
    if (path === location.pathname) link.setAttribute("aria-current", "page");
    tabs.append(link);
  }
  status.id = "status"; status.setAttribute("role", "status");
  header.replaceChildren(heading, tabs, status);
  document.title = title + " – AOMGen";
}

// JSON of a path; `body` makes it a POST request. An error of the server is thrown as its sentence.
async function ask(path, body, signal) {
  const options = body === undefined ? {signal} : {signal, method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify(body)};
  const answer = await fetchOrSay(path, options);
  return answer.json();
}

async function fetchOrSay(path, options) {
  let answer;
  try { answer = await fetch(path, options); }
  catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Error("aomgen view has ended: start it again");
  }
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer;
}

function say(text, poor = false) { $("status").textContent = text; $("status").className = poor ? "poor" : ""; }

// Values behind # of the address, for example {episode: "12", t: "3.4"}.
const readLink = () => Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
const writeLink = values => history.replaceState(null, "", "#" + new URLSearchParams(values));
