// Who placed a site, as the description of its point states it in a file (values/site_states.py).

export const UNPLACED = "not placed by a person";
const ORIGINS = {
  placed: "placed by hand",
  accepted: "proposed by cmfsim, accepted by a person",
  proposed: `proposed by cmfsim, ${UNPLACED}`,
  moved: `moved by cmfsim with the sites that were placed, ${UNPLACED}`,
  filled: `filled in by cmfsim from the other sites, ${UNPLACED}`,
};

/** Whether a person answers for a site of this origin. */
export const isDecided = (origin) => origin === "placed" || origin === "accepted";

/** The description of a point. */
export function descriptionOf({ origin, error, doubt }) {
  if (isDecided(origin)) return ORIGINS[origin];
  return `${ORIGINS[origin]}; expected error ${error.toFixed(1)} mm${doubt ? `; doubtful: ${doubt}` : ""}`;
}

/** The origin in the description of a point: one that says nothing was placed by a person. */
export function originOf(description) {
  if (!description.includes(UNPLACED)) return description.startsWith(ORIGINS.accepted) ? "accepted" : "placed";
  return Object.keys(ORIGINS).find((origin) => description.startsWith(ORIGINS[origin])) ?? "proposed";
}
