"""The model card: what a model is, what it needs, how good it is and where that ends. Markdown."""

from __future__ import annotations

from cgid.identification.model import Model


def write_card(model: Model, name: str, pictures: tuple[str, ...] = ()) -> str:
    """Return the card of a model.

    Parameters
    ----------
    model : Model
    name : str
        Of the model file.
    pictures : tuple of str
        File names, relative to the card.
    """
    training, metrics = model.training, model.training["metrics"]
    low, high = metrics["accuracy_interval_95"]
    rates = " to ".join(f"{rate / 1e3:g}" for rate in dict.fromkeys(model.sampling_rates))
    lines = [
        f"# Model card: {name}",
        "",
        f"Identifies {', '.join(model.labels)} from the {model.quantity} of one impact.",
        "",
        "| | |",
        "|---|---|",
        f"| family | {model.family}, probabilities calibrated by temperature {model.temperature:.4g} |",
        f"| expects | {model.quantity} [{model.unit}], positive pulses, trained at {rates} kHz |",
        f"| features | {', '.join(model.features)} |",
        f"| trained on | {training['n_train']} impacts of {training['n_train_specimens']} specimens |",
        f"| judged on | {metrics['n_impacts']} impacts of {training['n_test_specimens']} other specimens |",
        f"| left out | {training['n_left_out']} impacts that could not be measured |",
        f"| data (SHA-256 of the scene) | {', '.join(s or 'unknown' for s in training['sources'])} |",
        f"| seed | {training['seed']} |",
        f"| versions | {', '.join(f'{k} {v}' for k, v in training['versions'].items())} |",
        "",
        "## On impacts it has not seen",
        "",
        "| | |",
        "|---|---|",
        f"| accuracy | {metrics['accuracy']:.4f} (95 % interval {low:.4f} to {high:.4f}) |",
        *(f"| recall of {label} | {value:.4f} |" for label, value in metrics["recall"].items()),
        f"| Brier score (sum over the labels) | {metrics['brier_score']:.4f} |",
        f"| log loss | {metrics['log_loss']:.4f} |",
        f"| expected calibration error | {metrics['expected_calibration_error']:.4f} |",
        *(f"| area under the ROC curve, {label} | {value:.4f} |" for label, value in metrics["roc_area"].items()),
        "",
        "Confusion (rows: truth, columns: answer):",
        "",
        "| | " + " | ".join(model.labels) + " |",
        "|---|" + "---|" * len(model.labels),
        *(
            f"| {label} | " + " | ".join(map(str, row)) + " |"
            for label, row in zip(model.labels, metrics["confusion"], strict=True)
        ),
        "",
        *(f"![{picture}]({picture})" for picture in pictures),
        *([""] if pictures else []),
        "## Limits",
        "",
        "It knows the impacts of its training data and no others. An impact whose novelty passes 1 (the distance",
        "that 99.9 % of the training impacts keep) is answered with *unknown*; at another sampling rate it is less",
        "often right than it says. The interval counts specimens, not impacts.",
        "Data that was synthesised says how good the method can be, not how good it is in a mine.",
        "",
    ]
    if training["labels_shuffled"]:
        lines[1:1] = ["", "**Trained on shuffled labels: a check of the method, of no other use.**"]
    return "\n".join(lines)
