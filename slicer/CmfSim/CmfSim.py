"""CmfSim: choose a volume or models, move segments by transforms, and see the face follow.

Three buttons: the pieces of bone as they are cut, for the transforms; the face under these; and the
planning page, in which other plans are tried.

A thin widget. What it does with what was chosen is in CmfSimLib, which knows no Slicer; the
prediction itself runs in a process of its own.
"""

import importlib.util
import shutil
import tempfile
from pathlib import Path

import ctk
import qt
import vtk
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
)

import slicer
from CmfSimLib.case_folder import BONES, MODELS, Choice, ChoiceError, Segment, face_of, write_case
from CmfSimLib.running import Run, page_command, pieces_command, predict_command, words_of

ACTIVE = "displacement_length_mm"
COLOURS = "vtkMRMLColorTableNodeFileViridis.txt"
PIECES_BUTTON = "Show the pieces of bone"
FACE_BUTTON, PAGE_BUTTON = "Predict the face", "Make the planning page"
# How often a running prediction is asked for its progress, ms.
INTERVAL = 300


class CmfSim(ScriptedLoadableModule):
    """The module in Slicer's list."""

    def __init__(self, parent):
        super().__init__(parent)
        parent.title = "CmfSim"
        parent.categories = ["Planning"]
        parent.dependencies = []
        parent.contributors = ["The cmfsim maintainers"]
        parent.helpText = (
            "Predicts the face after jaw surgery. Choose a CT volume, or models of skin and bones; "
            "apply a linear transform to each segment that moves; run. Research software, not a "
            "medical device."
        )
        parent.acknowledgementText = (
            "The method follows Kim, Juergens, Weber, Nolte, Reyes: Progress in Biophysics and "
            "Molecular Biology 103 (2010) 284."
        )


class CmfSimWidget(ScriptedLoadableModuleWidget):
    """Choosers, a table of segments, a button, a bar."""

    def setup(self):
        """Builds the panel; cmfsim is neither installed nor imported here."""
        super().setup()
        self.logic = CmfSimLogic()
        self.run = None
        self.timer = qt.QTimer()
        self.timer.setInterval(INTERVAL)
        self.timer.connect("timeout()", self.onTimer)
        self._addInputs()
        self._addSegments()
        self._addRun()
        self.layout.addStretch(1)

    def cleanup(self):
        """Ends a prediction that still runs when the module is closed."""
        self.timer.stop()
        if self.run is not None:
            self.run.close()

    def _section(self, title):
        box = ctk.ctkCollapsibleButton()
        box.text = title
        self.layout.addWidget(box)
        return qt.QFormLayout(box)

    def _chooser(self, form, label, classes, tip):
        chooser = slicer.qMRMLNodeComboBox()
        chooser.nodeTypes = classes
        chooser.noneEnabled = True
        chooser.addEnabled = chooser.removeEnabled = False
        chooser.setMRMLScene(slicer.mrmlScene)
        chooser.setCurrentNode(None)
        chooser.toolTip = tip
        form.addRow(label, chooser)
        return chooser

    def _addInputs(self):
        form = self._section("Head before the operation")
        model, points = ["vtkMRMLModelNode"], ["vtkMRMLMarkupsFiducialNode"]
        self.volume = self._chooser(
            form,
            "CT volume:",
            ["vtkMRMLScalarVolumeNode"],
            "In HU; leave empty to use a skin model",
        )
        self.skin = self._chooser(form, "Skin model:", model, "Where no CT is chosen")
        found = "Optional: found automatically where there are none"
        self.skull = self._chooser(form, "Skull landmarks:", points, found)
        self.marks = self._chooser(form, "Skin landmarks:", points, found)

    def _addSegments(self):
        form = self._section("Bones, and the transform that moves each")
        self.table = qt.QTableWidget(0, 3)
        self.table.setHorizontalHeaderLabels(["Bone", "Model", "Moved by"])
        self.table.horizontalHeader().setSectionResizeMode(qt.QHeaderView.Stretch)
        form.addRow(self.table)
        add = qt.QPushButton("Add a bone")
        add.connect("clicked()", self.onAddBone)
        form.addRow(add)

    def onAddBone(self):
        """Adds a row: the bone's name, its model, its transform."""
        row = self.table.rowCount
        self.table.insertRow(row)
        names = qt.QComboBox()
        names.addItems(list(BONES))
        names.editable = True
        self.table.setCellWidget(row, 0, names)
        for column, cls in ((1, "vtkMRMLModelNode"), (2, "vtkMRMLLinearTransformNode")):
            chooser = slicer.qMRMLNodeComboBox()
            chooser.nodeTypes = [cls]
            chooser.noneEnabled = True
            chooser.addEnabled = chooser.removeEnabled = False
            chooser.setMRMLScene(slicer.mrmlScene)
            chooser.setCurrentNode(None)
            self.table.setCellWidget(row, column, chooser)

    def _addRun(self):
        form = self._section("Prediction")
        self.model = qt.QComboBox()
        self.model.addItems(list(MODELS))
        self.model.currentText = "M+S"
        form.addRow("Model:", self.model)
        self.edge = ctk.ctkDoubleSpinBox()
        self.edge.minimum, self.edge.maximum, self.edge.value = 1.0, 30.0, 6.0
        self.edge.suffix = " mm"
        form.addRow("Edge length:", self.edge)
        self.piecesButton = qt.QPushButton(PIECES_BUTTON)
        self.piecesButton.toolTip = "The bones named above as they are cut, before any moves"
        self.piecesButton.connect("clicked()", self.onPiecesButton)
        form.addRow(self.piecesButton)
        self.button = qt.QPushButton(FACE_BUTTON)
        self.button.connect("clicked()", self.onButton)
        form.addRow(self.button)
        self.pageButton = qt.QPushButton(PAGE_BUTTON)
        self.pageButton.toolTip = "One file for the browser: move the bones, see the face follow"
        self.pageButton.connect("clicked()", self.onPageButton)
        form.addRow(self.pageButton)
        self.bar = qt.QProgressBar()
        self.bar.visible = False
        form.addRow(self.bar)
        self.status = qt.QLabel()
        self.status.wordWrap = True
        form.addRow(self.status)

    def _rows(self):
        for row in range(self.table.rowCount):
            name, model, transform = (self.table.cellWidget(row, column) for column in range(3))
            yield name.currentText.strip(), model.currentNode(), transform.currentNode()

    def onPiecesButton(self):
        """Starts the cutting of the bones, or stops what runs."""
        self._start(pieces_command, self.showPieces, is_preview=True)

    def onButton(self):
        """Starts a prediction, or stops what runs."""
        self._start(predict_command, self.showPrediction)

    def onPageButton(self):
        """Starts the making of a planning page, or stops what runs."""
        self._start(page_command, self.showPage)

    def _start(self, command, show, *, is_preview=False):
        if self.run is not None:
            self.run.stop()
            return
        try:
            self.logic.ensureCmfsim()
            chosen = self.logic.choice(
                self.volume.currentNode(),
                self.skin.currentNode(),
                list(self._rows()),
                (self.skull.currentNode(), self.marks.currentNode()),
                (self.edge.value, self.model.currentText),
            )
            chosen.is_preview = is_preview
            self.case = write_case(self.logic.folder, chosen)
        except (ChoiceError, RuntimeError) as error:
            slicer.util.errorDisplay(str(error), windowTitle="CmfSim")
            return
        self.show = show
        self.run = Run(command(self.case, chosen.model, python=self.logic.python()))
        self.button.text = self.pageButton.text = self.piecesButton.text = "Stop"
        self.bar.visible = True
        self.bar.value = 0
        self.timer.start()

    def onTimer(self):
        """Shows the progress of what runs, and its result at the end."""
        for line in self.run.poll():
            self.status.text = line.text
            if line.share is not None:
                self.bar.value = int(100 * line.share)
        code = self.run.code
        if code is None:
            return
        self.timer.stop()
        run, self.run = self.run, None
        self.button.text, self.pageButton.text = FACE_BUTTON, PAGE_BUTTON
        self.piecesButton.text = PIECES_BUTTON
        self.bar.visible = False
        answer = run.answer()
        run.close()
        if code == 0:
            self.status.text = self.show(Path(self.case).parent / "out")
            return
        text = words_of(answer)
        self.status.text = text
        slicer.util.errorDisplay(text, windowTitle="CmfSim")

    def showPrediction(self, out):
        """Loads the face of a prediction, and states what is seen."""
        head = self.volume.currentNode() or self.skin.currentNode()
        self.logic.showFace(out / "prediction.mrb", head)
        return "The face is coloured by its displacement in mm."

    def showPieces(self, out):
        """Loads each piece of bone as a model, and states what they are."""
        head = self.volume.currentNode() or self.skin.currentNode()
        names = self.logic.showPieces(out, head)
        return f"Pieces: {', '.join(names)}. Give each that moves a row and a transform."

    def showPage(self, out):
        """Opens the planning page in the browser, and states where it is."""
        page = out / "plan.html"
        qt.QDesktopServices.openUrl(qt.QUrl.fromLocalFile(str(page)))
        return f"The planning page is {page}."


class CmfSimLogic(ScriptedLoadableModuleLogic):
    """The parts that need Slicer: saving nodes, matrices of transforms, showing the face."""

    def __init__(self):
        super().__init__()
        self.folder = None

    def ensureCmfsim(self):
        """Installs cmfsim into Slicer's Python when it is first needed, after asking.

        A wheel beside requirements.txt is installed if there is one: the package that belongs to
        this copy of the module. Otherwise the registry of Python packages has it.
        """
        resources = Path(__file__).parent / "Resources"
        wheels = sorted(resources.glob("cmfsim-*.whl"))
        asked = (resources / "requirements.txt").read_text(encoding="utf-8").split()
        if wheels:
            extras = "".join(asked).removeprefix("cmfsim")
            asked = [f"cmfsim{extras} @ {wheels[-1].as_uri()}"]
        try:
            from slicer.packaging import pip_ensure
        except ImportError:
            # Slicer 5.10 and earlier.
            if importlib.util.find_spec("cmfsim") is None:
                text = "CmfSim needs the Python package cmfsim. Install it?"
                if not slicer.util.confirmOkCancelDisplay(text, windowTitle="CmfSim"):
                    raise RuntimeError("cmfsim is not installed.") from None
                slicer.util.pip_install(asked)
            return
        pip_ensure(asked, requester="CmfSim")

    def python(self):
        """Slicer's own interpreter, which runs without its window."""
        found = shutil.which("PythonSlicer")
        if found is None:
            raise RuntimeError("PythonSlicer, Slicer's own Python, is not on the path.")
        return found

    def choice(self, volume, skin, rows, marks, settings):
        """The choice, with every node saved into a new folder."""
        self.folder = Path(tempfile.mkdtemp(prefix="CmfSim-", dir=slicer.app.temporaryPath))
        edge, model = settings
        made = Choice(edge_length=edge, model=model)
        if volume is not None:
            made.volume = self._saved(volume, "ct.nrrd")
        elif skin is not None:
            made.skin = self._saved(skin, "skin.vtp")
        for name, bone, transform in rows:
            file = self._saved(bone, f"{name}.vtp") if bone is not None and volume is None else None
            made.segments.append(Segment(name, file, self._matrix(transform)))
        for key, node in zip(("skull_landmarks", "skin_landmarks"), marks, strict=True):
            if node is not None:
                setattr(made, key, self._saved(node, f"{key}.mrk.json"))
        return made

    def _saved(self, node, name):
        path = self.folder / name
        if not slicer.util.saveNode(node, str(path), {"useCompression": False}):
            raise ChoiceError(f"{node.GetName()} could not be saved.")
        return path

    def _matrix(self, transform):
        """The effect of a transform alone: the rest of the head is under its parent, too."""
        if transform is None:
            return None
        matrix = vtk.vtkMatrix4x4()
        transform.GetMatrixTransformToParent(matrix)
        return tuple(tuple(matrix.GetElement(i, k) for k in range(4)) for i in range(4))

    def showPieces(self, out, head):
        """The names of the pieces of bone, loaded to where the head is shown."""
        files = sorted(out.glob("segment-*.ply"))
        names = [file.stem.removeprefix("segment-") for file in files]
        for file, name in zip(files, names, strict=True):
            self._loaded(file, name, head)
        return names

    def _loaded(self, file, name, head):
        """A model in a file, in LPS as Slicer takes it, under the transform of the head."""
        node = slicer.util.loadModel(str(file))
        node.SetName(name)
        if head is not None and head.GetParentTransformNode() is not None:
            node.SetAndObserveTransformNodeID(head.GetParentTransformNode().GetID())
        return node

    def showFace(self, bundle, head):
        """Loads the predicted face, coloured by its displacement, to where the head is shown."""
        node = self._loaded(face_of(bundle, self.folder), "face predicted", head)
        display = node.GetDisplayNode()
        display.SetActiveScalar(ACTIVE, vtk.vtkAssignAttribute.POINT_DATA)
        display.SetAndObserveColorNodeID(COLOURS)
        display.SetScalarVisibility(True)
        return node


class CmfSimTest(ScriptedLoadableModuleTest):
    """Run by Slicer: Reload and Test, or --testing."""

    def runTest(self):
        """The panel with an incomplete choice; the rest is tested without Slicer."""
        self.setUp()
        self.test_a_choice_without_a_head_is_refused()

    def test_a_choice_without_a_head_is_refused(self):
        """The error is a sentence, and no process is started."""
        logic = CmfSimLogic()
        made = logic.choice(None, None, [], (None, None), (6.0, "H"))
        with self.assertRaises(ChoiceError):
            write_case(logic.folder, made)
